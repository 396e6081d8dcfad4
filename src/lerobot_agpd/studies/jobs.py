"""Run several jobs at a time, each a chain of commands in processes of their own."""

from __future__ import annotations

import fcntl
import logging
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

logger = logging.getLogger(__name__)

LOCK = "lock"
LAST_LINES = 15
GRACE = 10.0

Execute = Callable[[Sequence[str], Path], None]
"""Runs a command whose output goes to the end of a log; raises RuntimeError with the log's end if it fails."""


@dataclass(frozen=True)
class Job:
    """Work on a folder.

    Attributes:
        name: as shown.
        folder: locked meanwhile.
        work: called with what runs a command; an exception ends the job.
    """

    name: str
    folder: Path
    work: Callable[[Execute], None]


class Processes:
    """The processes that jobs have started and that still run."""

    def __init__(self, threads: int):
        self.env = {**os.environ, "OMP_NUM_THREADS": str(threads)}
        self.running: set[subprocess.Popen[bytes]] = set()

    def run(self, job: Job, bars: Progress) -> None:
        """Do a job's work in its locked folder."""
        with _locked(job.folder) as lock:
            bar = bars.add_task(job.name, total=None)
            try:
                job.work(lambda command, log: self._execute(command, log, lock))
            finally:
                bars.remove_task(bar)

    def _execute(self, command: Sequence[str], log: Path, lock: int) -> None:
        """Run a command; it holds the lock too, so that the folder stays locked if this process is killed."""
        with (
            log.open("ab") as out,
            subprocess.Popen(  # noqa: S603  # no shell; the commands are those of the user's matrix
                command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, env=self.env, pass_fds=[lock]
            ) as process,
        ):
            self.running.add(process)
            returncode = process.wait()
            self.running.discard(process)
        if returncode:
            raise RuntimeError(f"ended with {returncode}; the end of {log}:\n{_last_lines(log)}")

    def end(self, futures: Iterable[Future[None]]) -> None:
        """End all processes and wait for the threads that run them."""
        deadline = time.monotonic() + GRACE
        while not all(future.done() for future in futures):
            for process in list(self.running):
                process.terminate() if time.monotonic() < deadline else process.kill()
            time.sleep(0.1)


def run_jobs(jobs: Sequence[Job], at_once: int, threads: int, console: Console) -> dict[str, str]:
    """Run jobs, `at_once` at a time; returns the errors by job.

    A job whose folder another process works on is left alone: a started command holds the folder's lock even if
    this process is killed.

    Raises:
        SystemExit: after an interrupt or SIGTERM, which ends all processes that were started.
    """
    failures: dict[str, str] = {}
    processes = Processes(threads)
    counted = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    columns = (SpinnerColumn(), TextColumn("{task.description}"), *counted)
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: raises KeyboardInterrupt
    with Progress(*columns, console=console, transient=True) as bars, ThreadPoolExecutor(at_once) as pool:
        total = bars.add_task("runs", total=len(jobs))
        futures = {pool.submit(processes.run, job, bars): job for job in jobs}
        try:
            for future in as_completed(futures):
                name, error = futures[future].name, future.exception()
                bars.advance(total)
                if error is None:
                    logger.info("%s: finished", name)
                else:
                    failures[name] = str(error)
                    logger.error("%s: %s", name, error)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            processes.end(futures)
            raise SystemExit("interrupted; run the same command to go on") from None
        finally:
            signal.signal(signal.SIGTERM, before)
    return failures


def _last_lines(log: Path) -> str:
    """The end of a log, where the reason of a failure stands."""
    lines = log.read_text(errors="replace").replace("\r", "\n").splitlines()
    return "\n".join([line for line in lines if line.strip()][-LAST_LINES:])


@contextmanager
def _locked(folder: Path) -> Iterator[int]:
    """Hold a folder's lock; yields its file descriptor.

    Raises:
        BlockingIOError: if another process works on the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BlockingIOError(f"another process works on {folder} (it holds {LOCK})") from error
        yield file.fileno()
