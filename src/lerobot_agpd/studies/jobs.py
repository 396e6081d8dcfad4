"""Run several jobs at a time, each a chain of commands in processes of their own."""

from __future__ import annotations

import asyncio
import fcntl
import logging
import os
import re
import signal
from collections.abc import Callable, Iterator, Sequence
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
BAR = re.compile(rb"([A-Z][\w ]*?): +\d+%\|[^|]*\| (\d+/\d+)")
LOG_TAIL = 4000
LAST_LINES = 15
GRACE = 10.0
POLL = 1.0


@dataclass(frozen=True)
class Step:
    """One command of a job.

    Attributes:
        command: returns the arguments when the step's turn comes; None if nothing is left to do.
        log: file that takes what it prints.
        done: called with the return code.
    """

    command: Callable[[], Sequence[str] | None]
    log: Path
    done: Callable[[int], None] = lambda returncode: None


@dataclass(frozen=True)
class Job:
    """A run's steps, in order; a failed one ends the job."""

    name: str
    folder: Path
    steps: Sequence[Step]


def run_jobs(jobs: Sequence[Job], at_once: int, threads: int, console: Console) -> dict[str, str]:
    """Run jobs, `at_once` at a time; returns the errors by job.

    A job whose folder another process works on is left alone: a started command holds the folder's lock even if
    this process is killed.

    Raises:
        SystemExit: after an interrupt or SIGTERM, which ends all processes that were started.
    """
    failures: dict[str, str] = {}
    counted = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    columns = (SpinnerColumn(), TextColumn("{task.description}"), *counted)
    with Progress(*columns, console=console, transient=True) as bars:
        try:
            asyncio.run(_run_all(jobs, at_once, threads, bars, failures))
        except (asyncio.CancelledError, KeyboardInterrupt):
            raise SystemExit("interrupted; run the same command to go on") from None
    return failures


async def _run_all(
    jobs: Sequence[Job], at_once: int, threads: int, bars: Progress, failures: dict[str, str]
) -> None:
    slots = asyncio.Semaphore(at_once)
    total = bars.add_task("runs", total=len(jobs))
    main = asyncio.current_task()
    assert main is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, main.cancel)

    async def work(job: Job) -> None:
        async with slots:
            bar = bars.add_task(job.name, total=None)
            problem = await _run_job(job, threads, lambda text: bars.update(bar, description=text))
            bars.remove_task(bar)
            bars.advance(total)
            if problem:
                failures[job.name] = problem
                logger.error("%s: %s", job.name, problem)
            else:
                logger.info("%s: finished", job.name)

    async with asyncio.TaskGroup() as group:
        for job in jobs:
            group.create_task(work(job))


async def _run_job(job: Job, threads: int, show: Callable[[str], None]) -> str | None:
    """Run a job in its locked folder; returns the reason if that fails."""
    try:
        with _locked(job.folder) as lock:
            return await _run_steps(job, threads, lock, show)
    except (OSError, ValueError) as error:
        return str(error)


async def _run_steps(job: Job, threads: int, lock: int, show: Callable[[str], None]) -> str | None:
    """Run a job's steps; returns the reason if one fails."""
    for step in job.steps:
        command = step.command()
        if command is None:
            continue
        with step.log.open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                *command,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, "OMP_NUM_THREADS": str(threads)},
                pass_fds=[lock],
            )
            returncode = await _wait(process, lambda text: show(f"{job.name}  {text}"), step.log)
        step.done(returncode)
        if returncode:
            return f"ended with {returncode}; the end of {step.log}:\n{_last_lines(step.log)}"
    return None


async def _wait(process: asyncio.subprocess.Process, show: Callable[[str], None], log: Path) -> int:
    """Wait for a process, showing its progress; end it when canceled."""
    try:
        while True:
            try:
                return await asyncio.wait_for(asyncio.shield(process.wait()), POLL)
            except TimeoutError:
                show(activity(log))
    finally:
        if process.returncode is None:
            process.terminate()
            try:
                await asyncio.wait_for(process.wait(), GRACE)
            except TimeoutError:
                process.kill()


def activity(log: Path) -> str:
    """Read a log's last progress bar, e.g. `Training 135/300`; empty without one."""
    if not log.exists():
        return ""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - LOG_TAIL))
        bars = BAR.findall(file.read())
    return b" ".join(bars[-1]).decode() if bars else ""


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
