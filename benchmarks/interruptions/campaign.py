"""Kill tiny runs at every file operation of their rounds and at random times, continue them, and look for losses.

    python benchmarks/interruptions/campaign.py --output benchmarks/interruptions/counts.json

A run (benchmarks/tiny_runs.py) is killed with SIGKILL, all its processes, and continued with the flags that the run itself
would name (`lerobot_agpd.continuation`), on the same or another number of processes, until it ends; then it is compared
with what was there when it died. The output is written after every trial, and a later call takes up where it ended.
"""

# ruff: noqa: E402  # the folder above must be found first

import argparse
import json
import os
import random
import shlex
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from losses import Snapshot, check
from tiny_runs import EPISODES, ROUNDS, STEPS, isolated, prepare, train

from lerobot_agpd.continuation import how_to_continue
from lerobot_agpd.files import write_json


@dataclass(frozen=True)
class Kill:
    """When a run is killed.

    Attributes:
        operation: before the n-th operation of a process on the journal's files.
        rank: of that process.
        moment: or at this fraction of the time that an undisturbed run takes.
    """

    operation: int | None = None
    rank: int = 0
    moment: float | None = None


@dataclass(frozen=True)
class Trial:
    """A run that is killed and continued.

    Attributes:
        processes: of the first attempt, the second and so on.
        kills: of all attempts but the last.
    """

    processes: tuple[int, ...]
    kills: tuple[Kill, ...]


# ---- counted operations ----


def count_operations(root: Path, on_operation: Callable[[], None]) -> None:
    """Call back before every operation that changes the journal's files, merged datasets left out."""

    def concerns(path: object) -> bool:
        text = os.fsdecode(path) if isinstance(path, str | bytes | os.PathLike) else ""
        return text.startswith(str(root)) and "/merged" not in text

    def hook(event: str, args: tuple[object, ...]) -> None:
        writes = event == "open" and bool(int(args[2]) & (os.O_WRONLY | os.O_RDWR))  # type: ignore[call-overload]
        if (writes or event in ("os.rename", "os.remove", "os.mkdir")) and concerns(args[0]):
            on_operation()

    fsync = os.fsync

    def counted_fsync(descriptor: int) -> None:
        if concerns(os.readlink(f"/proc/self/fd/{descriptor}")):
            on_operation()
        fsync(descriptor)

    os.fsync = counted_fsync
    sys.addaudithook(hook)


@dataclass
class Attempt:
    """One call of `lerobot-train`, by one or several processes, which may be killed.

    Attributes:
        flags: of `lerobot-train`.
        folder: of its logs, and of the numbers of operations.
        root: of the journal.
        n_ranks: processes.
        kill: when it is killed.
    """

    flags: list[str]
    folder: Path
    root: Path
    n_ranks: int
    kill: Kill

    def run(self, seconds: float) -> list[int]:
        """Run it, given the seconds of an undisturbed run; returns the exit codes."""
        moment = self.kill.moment
        limit = None if moment is None else moment * seconds
        return train(self.flags, self.folder, self.n_ranks, self._inside, limit)

    @contextmanager
    def _inside(self, rank: int) -> Iterator[None]:
        operations = 0

        def count() -> None:
            nonlocal operations
            operations += 1
            if self.kill.rank == rank and self.kill.operation == operations:
                os.kill(os.getpid(), signal.SIGKILL)

        count_operations(self.root, count)
        yield
        (self.folder / f"rank-{rank}.operations").write_text(str(operations))


# ---- one trial ----


def run_trial(trial: Trial, flags: list[str], folder: Path, seconds: dict[int, float]) -> dict[str, object]:
    """Kill, continue and check; returns how often it was killed, how it was continued, and what is wrong."""
    output, root = folder / "run", folder / "run" / "agpd"
    args, before, ways = [*flags, f"--output_dir={output}"], Snapshot({}, {}), []
    outcome: dict[str, object] = {"killed": 0, "continued": ways}
    for number, n_ranks in enumerate(trial.processes):
        kill = trial.kills[number] if number < len(trial.kills) else Kill()
        attempt = Attempt(args, folder / f"attempt-{number}", root, n_ranks, kill)
        codes = attempt.run(seconds[n_ranks])
        if not any(codes):
            break  # it was faster than its killer
        if signal.SIGKILL not in [-code for code in codes] or kill == Kill():
            logs = [path.read_text(errors="replace")[-800:] for path in attempt.folder.glob("*.log")]
            return {**outcome, "problems": [f"attempt {number} failed: {codes} {logs}"]}
        now = Snapshot.of(root, ROUNDS)
        if lost := before.lost(now):
            return {**outcome, "problems": lost}
        before, outcome["killed"] = now, number + 1
        text = how_to_continue(output, root)
        resumed = "it goes on with: lerobot-train" in text
        named = shlex.split(text.rpartition("lerobot-train " if resumed else "two flags: ")[2])
        ways.append("resumed from a checkpoint" if resumed else "repeated with its episodes")
        args = named if resumed else [*flags, *named]
        output = output if resumed else Path(named[0].removeprefix("--output_dir="))
    problems = isolated(lambda: check(before, output, root, ROUNDS, EPISODES, STEPS))
    return {**outcome, "episodes": len(before.records), "kept": len(before.frames), "problems": problems}


# ---- the campaign ----


def measure(flags: list[str], folder: Path, n_ranks: int) -> tuple[list[int], float]:
    """File operations of every process of an undisturbed run, and its seconds."""
    began = time.monotonic()
    attempt = Attempt(
        [*flags, f"--output_dir={folder / 'run'}"], folder, folder / "run" / "agpd", n_ranks, Kill()
    )
    codes = attempt.run(0)
    assert not any(codes), (folder / "rank-0.log").read_text()[-2000:]
    counts = [int((folder / f"rank-{rank}.operations").read_text()) for rank in range(n_ranks)]
    return counts, time.monotonic() - began


def plan(operations: dict[int, list[int]], times: int, seed: int) -> list[Trial]:
    """A kill at every operation, and pairs of kills at random times, in random order."""
    rng, planned = random.Random(seed), []
    for n_ranks, counts in operations.items():
        for rank, n_operations in enumerate(counts):
            for operation in range(1, n_operations + 1):
                planned.append(Trial((n_ranks, rng.choice((1, 2))), (Kill(operation, rank),)))
        for _ in range(times // 2):
            moments = tuple(Kill(moment=round(rng.uniform(0, 1), 3)) for _ in range(2))
            planned.append(Trial((n_ranks, *(rng.choice((1, 2)) for _ in moments)), moments))
    rng.shuffle(planned)
    return planned


def read_done(path: Path) -> list[dict[str, object]]:
    """Trials of an earlier call that wrote to the same file."""
    return json.loads(path.read_text())["trials"] if path.exists() else []


def main() -> None:
    """Run the campaign, print progress, write every trial."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--times", type=int, default=100, help="trials with kills at random times")
    parser.add_argument("--every", type=int, default=1, help="take every n-th trial")
    parser.add_argument("--minutes", type=float, default=240, help="stop after so many minutes")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    began, done = time.monotonic(), read_done(options.output)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        flags = prepare(folder)
        measured = {n_ranks: measure(flags, folder / f"undisturbed-{n_ranks}", n_ranks) for n_ranks in (1, 2)}
        seconds = {n_ranks: duration for n_ranks, (_, duration) in measured.items()}
        operations = {n_ranks: counts for n_ranks, (counts, _) in measured.items()}
        planned = plan(operations, options.times, options.seed)
        known = [entry["trial"] for entry in done]
        for number, trial in enumerate(planned[:: options.every]):
            name = json.loads(json.dumps(asdict(trial)))
            if name in known:
                continue
            if time.monotonic() - began > 60 * options.minutes:
                break
            started = time.monotonic()
            outcome = run_trial(trial, flags, folder / f"trial-{number}", seconds)
            shutil.rmtree(folder / f"trial-{number}")
            done.append({"trial": name, "seconds": round(time.monotonic() - started, 1), **outcome})
            sys.stderr.write(f"{len(done)} of {len(planned)}: {json.dumps(done[-1])}\n")
            content = {"file_operations": operations, "seconds": seconds, "planned": len(planned)}
            write_json(options.output, {"command": shlex.join(sys.argv), **content, "trials": done})


if __name__ == "__main__":
    main()
