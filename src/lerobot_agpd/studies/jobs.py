"""Run jobs by an executor of `concurrent.futures`' interface, each a chain of commands in processes of their own."""

from __future__ import annotations

import fcntl
import logging
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

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
GRACE, POLL = 10.0, 0.1
"""Seconds that a command has to end when it is told to, and between two looks at what has ended."""

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


class Submitted(Protocol):
    """What an executor returns: the part of `concurrent.futures.Future` that other libraries have too."""

    def done(self) -> bool:
        """Whether it has ended."""

    def exception(self) -> BaseException | None:
        """What ended it, if it is done."""

    def cancel(self) -> object:
        """End it, or keep it from starting."""


class Executor(Protocol):
    """`concurrent.futures.Executor`, or another library's."""

    def submit(self, function: Callable[[Job], None], job: Job, /) -> Submitted:
        """Have the function called with the job, perhaps on another machine."""


@dataclass
class Commands:
    """Runs the commands of jobs, and knows those that still run in this process.

    Attributes:
        threads: OMP_NUM_THREADS of each.
    """

    threads: int
    running: set[subprocess.Popen[bytes]] = field(default_factory=set)

    def run(self, job: Job) -> None:
        """Do a job's work in its locked folder."""
        with _locked(job.folder) as lock:
            job.work(lambda command, log: self._execute(command, log, lock))

    def _execute(self, command: Sequence[str], log: Path, lock: int) -> None:
        """Run a command; it holds the lock too, so that the folder stays locked if this process is killed."""
        env = {**os.environ, "OMP_NUM_THREADS": str(self.threads)}
        with (
            log.open("ab") as out,
            subprocess.Popen(  # noqa: S603  # no shell; the commands are those of the user's matrix
                command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, env=env, pass_fds=[lock]
            ) as process,
        ):
            self.running.add(process)
            returncode = process.wait()
            self.running.discard(process)
        if returncode:
            raise RuntimeError(f"ended with {returncode}; the end of {log}:\n{_last_lines(log)}")

    def end(self, submitted: Iterable[Submitted]) -> None:
        """End all jobs, and wait for those of this process."""
        waiting = list(submitted)
        for future in waiting:
            future.cancel()
        deadline = time.monotonic() + GRACE
        while not all(future.done() for future in waiting) and time.monotonic() < 2 * GRACE + deadline:
            for process in list(self.running):
                process.terminate() if time.monotonic() < deadline else process.kill()
            time.sleep(POLL)


def run_jobs(jobs: Sequence[Job], executor: Executor, threads: int, console: Console) -> dict[str, str]:
    """Run jobs, as many at a time as the executor does; returns the errors by job.

    A job whose folder another process works on is left alone: a started command holds the folder's lock even if
    this process is killed.

    Raises:
        SystemExit: after an interrupt or SIGTERM, which ends everything that was started.
    """
    failures: dict[str, str] = {}
    commands = Commands(threads)
    columns = (SpinnerColumn(), TextColumn("runs"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: raises KeyboardInterrupt
    waiting: dict[Submitted, Job] = {}
    with Progress(*columns, console=console, transient=True) as bars:
        total = bars.add_task("", total=len(jobs))
        try:
            for job in jobs:
                waiting[executor.submit(commands.run, job)] = job
            while waiting:
                for future in [future for future in waiting if future.done()]:
                    name, error = waiting.pop(future).name, future.exception()
                    bars.advance(total)
                    if error is None:
                        logger.info("%s: finished", name)
                    else:
                        failures[name] = str(error)
                        logger.error("%s: %s", name, error)
                time.sleep(POLL)
        except KeyboardInterrupt:
            commands.end(waiting)
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
