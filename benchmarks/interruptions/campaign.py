"""Kill tiny runs at every file operation of their rounds and at random times, continue them, and look for losses.

    python benchmarks/interruptions/campaign.py --output benchmarks/interruptions/counts.json

Every run is `lerobot-train` with the point environment of tests/plugins: six steps, two rounds of four episodes, a
checkpoint after step 3. It is killed (SIGKILL, all its processes), continued with the flags that the run itself would name
(`lerobot_agpd.continuation`), with the same or another number of processes, and compared with what was there when it died.
"""

# ruff: noqa: E402  # the plugin of the tests must be found first

import argparse
import hashlib
import json
import os
import random
import shlex
import shutil
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch

os.environ.setdefault("HF_HUB_OFFLINE", "1")
TESTS = Path(__file__).parents[2] / "tests"
sys.path[:0] = [str(TESTS / "plugins"), str(TESTS / "e2e")]

import lerobot_env_point  # noqa: F401
from commands import TINY_STUDENT, TINY_TEACHER, dataset_flags
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_train

import lerobot_agpd.plugin  # noqa: F401
from lerobot_agpd.continuation import how_to_continue
from lerobot_agpd.replay.journal import FRAMES_NAME, EpisodeJournal

EPISODES, ROUNDS, STEPS = 4, 2, 6
RUN = [
    *TINY_STUDENT,
    "--env.type=point",
    "--policy.collect.warmup=2",
    "--policy.collect.every=2",
    f"--policy.collect.episodes={EPISODES}",
    "--policy.collect.n_envs=2",
    "--policy.adversary.start=1",
    f"--steps={STEPS}",
    "--save_freq=3",
]
TIMEOUT = 900


@dataclass(frozen=True)
class Kill:
    """When a run is killed: before the n-th file operation of a process, or after some seconds."""

    operation: int | None = None
    rank: int = 0
    seconds: float | None = None


# ---- processes ----


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


def fork(flags: list[str], log: Path, rank: int, n_ranks: int, port: int, root: Path, kill: Kill) -> int:
    """Run `lerobot-train` in a fork of this process; returns its id."""
    process = os.fork()
    if process:
        return process
    os.setpgid(0, 0)
    status, operations = 1, 0

    def count() -> None:
        nonlocal operations
        operations += 1
        if kill.rank == rank and kill.operation == operations:
            os.kill(os.getpid(), signal.SIGKILL)

    try:
        with log.open("wb") as file:
            os.dup2(file.fileno(), 1), os.dup2(file.fileno(), 2)
        if n_ranks > 1:
            ranks = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": n_ranks, "LOCAL_WORLD_SIZE": n_ranks}
            os.environ |= {name: str(value) for name, value in ranks.items()}
            os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        count_operations(root, count)
        sys.argv = ["lerobot-train", *flags]
        lerobot_train.main()
        log.with_suffix(".operations").write_text(str(operations))
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(status)


def train(flags: list[str], folder: Path, n_ranks: int, root: Path, kill: Kill | None = None) -> list[int]:
    """Run `lerobot-train` on so many processes to its end, or until it is killed; returns the exit codes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    folder.mkdir(parents=True, exist_ok=True)
    running = {
        fork(flags, folder / f"rank-{rank}.log", rank, n_ranks, port, root, kill or Kill())
        for rank in range(n_ranks)
    }
    began, codes = time.monotonic(), []
    limit = kill.seconds if kill and kill.seconds is not None else TIMEOUT
    while running:
        process, status = os.waitpid(-1, os.WNOHANG)
        if process:
            running.discard(process)
            codes.append(os.waitstatus_to_exitcode(status))
        if (process and codes[-1]) or time.monotonic() - began > limit:
            limit = TIMEOUT
            for other in running:  # as a launcher does
                os.kill(other, signal.SIGKILL)
        time.sleep(0.01)
    return codes


# ---- what is on disk ----


@dataclass(frozen=True)
class Snapshot:
    """Records and hashes of frames, by round and episode."""

    records: dict[tuple[int, int], str]
    frames: dict[tuple[int, int], str]

    @classmethod
    def of(cls, root: Path) -> "Snapshot":
        """What a journal holds; duplicates raise AssertionError."""
        journal, records, frames = EpisodeJournal(root), {}, {}
        for number in range(ROUNDS):
            entries = journal.records(number)
            assert len({entry.number for entry in entries}) == len(entries), "an episode is there twice"
            records |= {(number, entry.number): repr(entry) for entry in entries}
            for episode in journal.kept(number):
                content = b"".join(
                    np.ascontiguousarray(episode.column(key)).tobytes() for key in episode.keys
                )
                frames[number, episode.record.number] = hashlib.sha256(content).hexdigest()
        return cls(records, frames)


def leftovers(root: Path) -> list[str]:
    """Files of a finished run's journal that belong to nothing."""
    journal, names = EpisodeJournal(root), []
    for path in root.iterdir():
        if path.name not in ("journal.json", "merged") and not path.name.startswith("round-"):
            names.append(path.name)
    for number in range(ROUNDS):
        claimed = {episode.path.stem for episode in journal.kept(number)}
        for path in journal.folder(number).iterdir():
            frames = FRAMES_NAME.fullmatch(path.name)
            ours = path.name == "report.json" or path.suffix == ".jsonl"
            if not ours and not (frames and not frames["partial"] and frames["stem"] in claimed):
                names.append(f"{path.parent.name}/{path.name}")
    return names


def check(before: Snapshot, output: Path, root: Path) -> list[str]:
    """What is wrong with a run that was continued to its end."""
    after, journal, problems = Snapshot.of(root), EpisodeJournal(root), []
    lost = [key for key, record in before.records.items() if after.records.get(key) != record]
    lost += [key for key, content in before.frames.items() if after.frames.get(key) != content]
    if lost:
        problems.append(f"lost or changed: {sorted(set(lost))}")
    if sorted(after.records) != [(n, e) for n in range(ROUNDS) for e in range(EPISODES)]:
        problems.append(f"episodes {sorted(after.records)}")
    for number, report in enumerate(journal.reports()):
        counts = {"generated": len(journal.records(number)), "kept": len(journal.kept(number))}
        if any(report["total"][name] != count for name, count in counts.items()):
            problems.append(f"report of round {number}: {report['total']}, index: {counts}")
    if len(journal.reports()) != ROUNDS:
        problems.append(f"{len(journal.reports())} finished rounds")
    merged = LeRobotDataset("local/merged", root=root / "merged").num_episodes if after.frames else 0
    if merged != len(after.frames):
        problems.append(f"{merged} merged episodes, {len(after.frames)} kept ones")
    if not (output / "checkpoints" / f"{STEPS:06d}" / "training_state").is_dir():
        problems.append("no last checkpoint")
    return problems + [f"left over: {name}" for name in leftovers(root)]


# ---- one killed run ----


@dataclass(frozen=True)
class Trial:
    """A run that is killed on some processes and continued on others."""

    flags: list[str]
    processes: tuple[int, int]
    kill: Kill


def isolated(function: Callable[[], object]) -> object:
    """Call a function in a fork, since datasets start threads that must not be forked; returns its JSON result."""
    reading, writing = os.pipe()
    process = os.fork()
    if not process:
        try:
            os.write(writing, json.dumps(function()).encode())
        except BaseException:
            os.write(writing, json.dumps([f"check failed: {traceback.format_exc()[-600:]}"]).encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as file:
        content = file.read()
    os.waitpid(process, 0)
    return json.loads(content)


def run_trial(trial: Trial, folder: Path) -> tuple[str, list[str]]:
    """Kill, continue and check; returns how the run was continued, and what is wrong."""
    output, root = folder / "run", folder / "run" / "agpd"
    codes = train([*trial.flags, f"--output_dir={output}"], folder, trial.processes[0], root, trial.kill)
    if not any(codes):
        return "ended before it was killed", []
    before = Snapshot.of(root)
    text = how_to_continue(output, root)
    resumed = "it goes on with: lerobot-train" in text
    flags = shlex.split(text.rpartition("lerobot-train " if resumed else "two flags: ")[2])
    if not resumed:
        output, flags = folder / "run-2", [*trial.flags, *flags]
    codes = train(flags, folder / "again", trial.processes[1], root)
    if any(codes):
        logs = [path.read_text(errors="replace")[-800:] for path in (folder / "again").glob("*.log")]
        return "", [f"the continued run failed: {codes} {logs}"]
    problems = isolated(lambda: check(before, output, root))
    assert isinstance(problems, list)
    return "resumed from a checkpoint" if resumed else "repeated with its episodes", problems


# ---- the campaign ----


def demonstrate(root: Path) -> None:
    """Walks straight to the goal."""
    vector = {"dtype": "float32", "shape": (2,), "names": None}
    keys = ("observation.state", "observation.environment_state", "action")
    dataset = LeRobotDataset.create(
        "local/test", fps=10, features=dict.fromkeys(keys, vector), root=root, use_videos=False
    )
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        goal = np.array([np.cos(angle), np.sin(angle)], dtype=np.float32)
        for step in range(8):
            values = (goal * min(step / 4, 1), goal, goal * (step < 4))
            dataset.add_frame({**dict(zip(keys, map(np.float32, values), strict=True)), "task": "walk"})
        dataset.save_episode()
    dataset.finalize()


def prepare(folder: Path) -> list[str]:
    """Flags of the runs, with demonstrations and a teacher that are made here."""
    isolated(lambda: demonstrate(folder / "demos"))
    dataset, teacher = dataset_flags(folder / "demos"), folder / "teacher"
    codes = train(
        [*TINY_TEACHER, *dataset, "--steps=150", f"--output_dir={teacher}"], folder / "log", 1, folder
    )
    assert codes == [0], (folder / "log" / "rank-0.log").read_text()[-2000:]
    path = teacher / "checkpoints" / "last" / "pretrained_model"
    return [*RUN, *dataset, f"--policy.teacher.path={path}"]


def measure(flags: list[str], folder: Path, n_ranks: int) -> tuple[list[int], float]:
    """File operations of every process of an undisturbed run, and its seconds."""
    began = time.monotonic()
    codes = train([*flags, f"--output_dir={folder / 'run'}"], folder, n_ranks, folder / "run" / "agpd")
    assert not any(codes), (folder / "rank-0.log").read_text()[-2000:]
    counts = [int((folder / f"rank-{rank}.operations").read_text()) for rank in range(n_ranks)]
    return counts, time.monotonic() - began


def trials(flags: list[str], folder: Path, times: int, seed: int) -> tuple[list[Trial], dict[str, list[int]]]:
    """All kills at operations, one after the other, then those at random times."""
    rng, planned, counts = random.Random(seed), [], {}
    for n_ranks in (1, 2):
        counts[str(n_ranks)], seconds = measure(flags, folder / f"undisturbed-{n_ranks}", n_ranks)
        for rank, n_operations in enumerate(counts[str(n_ranks)]):
            for operation in range(1, n_operations + 1):
                after = rng.choice((1, 2))
                planned.append(Trial(flags, (n_ranks, after), Kill(operation, rank)))
        for _ in range(times // 2):
            moment = Kill(seconds=rng.uniform(0, seconds))
            planned.append(Trial(flags, (n_ranks, rng.choice((1, 2))), moment))
    return planned, counts


def main() -> None:
    """Run the campaign, print progress, write the counts."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--times", type=int, default=100, help="kills at random times")
    parser.add_argument("--every", type=int, default=1, help="take every n-th kill at an operation or time")
    parser.add_argument("--minutes", type=float, default=60, help="stop after so many minutes, and say so")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    began, outcomes, problems, n_done = time.monotonic(), Counter[str](), [], 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        flags = prepare(folder)
        planned, counts = trials(flags, folder, options.times, options.seed)
        random.Random(options.seed).shuffle(planned)
        for number, trial in enumerate(islice(planned, 0, None, options.every)):
            if time.monotonic() - began > 60 * options.minutes:
                break
            kind = "time" if trial.kill.seconds is not None else "operation"
            outcome, found = run_trial(trial, folder / f"trial-{number}")
            shutil.rmtree(folder / f"trial-{number}")
            n_done += 1
            outcomes[f"{trial.processes[0]} -> {trial.processes[1]}, {kind}: {outcome or 'failed'}"] += 1
            problems += [{"trial": repr(replace(trial, flags=[])), "problem": text} for text in found]
            sys.stderr.write(f"{number}: {trial.processes} {trial.kill} {outcome} {found}\n")
    result = {
        "command": shlex.join(sys.argv),
        "file_operations": counts,
        "planned": len(planned),
        "done": n_done,
        "outcomes": dict(sorted(outcomes.items())),
        "problems": problems,
    }
    options.output.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
