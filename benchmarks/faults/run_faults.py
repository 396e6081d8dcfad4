"""Faults of disks, folders and commands, and signals."""

import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import damage
from fault import Bench, Fault
from tiny_runs import Inside

from lerobot_agpd.continuation import how_to_continue
from lerobot_agpd.replay.journal import EpisodeJournal

# ---- disks, and folders of others ----


@contextmanager
def _small_disk(folder: Path, size: str) -> Iterator[None]:
    folder.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def full_disk(bench: Bench) -> Inside:
    """The run's process sees a small disk where its episodes are to go; when it has ended, they are copied away."""
    disk = bench.folder / "disk"

    @contextmanager
    def inside(rank: int) -> Iterator[None]:
        with _small_disk(disk, "16k"):
            try:
                yield
            finally:
                shutil.copytree(disk, bench.folder / "rescued")

    return inside


def _kept_on_full_disk(bench: Bench) -> list[str]:
    """Whether what had been kept is whole."""
    journal = EpisodeJournal(bench.folder / "rescued" / "agpd")
    episodes = journal.kept(0)
    for episode in episodes:
        for key in episode.keys:
            _ = episode.column(key)
    return [] if episodes else ["nothing was kept before the disk was full"]


def foreign_merged(bench: Bench) -> list[str]:
    """A folder of somebody else where the merged episodes are to go."""
    theirs = bench.folder / "root" / "merged" / "theirs.txt"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("theirs")
    return bench.begin(f"--policy.replay.root={bench.folder / 'root'}")


def _theirs_is_there(bench: Bench) -> list[str]:
    theirs = bench.folder / "root" / "merged" / "theirs.txt"
    return [] if theirs.is_file() and theirs.read_text() == "theirs" else ["somebody's file was deleted"]


def copied_without_episodes(bench: Bench) -> list[str]:
    """Checkpoints that were copied to another folder without `agpd`, while the original is still there."""
    original = bench.source / "finished"
    shutil.copytree(original / "checkpoints", bench.output / "checkpoints", symlinks=True)
    return bench.resume()


def original_command(bench: Bench) -> list[str]:
    """The command that started a run, once more, after a kill before the first checkpoint."""
    shutil.rmtree(bench.finished() / "checkpoints")
    return bench.begin()


def other_settings(*more: str):
    """A run without checkpoints is repeated with its episodes and other settings."""

    def inject(bench: Bench) -> list[str]:
        root = bench.finished() / "agpd"
        return [*bench.flags, f"--output_dir={bench.folder / 'again'}", f"--policy.replay.root={root}", *more]

    return inject


def without_last(bench: Bench) -> list[str]:
    """Resumed through a link that a kill has left out."""
    (bench.finished() / "checkpoints" / "last").unlink()
    config = bench.output / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    return [f"--config_path={config}", "--resume=true"]


RUNS = [
    Fault(
        "the disk of the episodes is full",
        lambda bench: bench.begin(f"--policy.replay.root={bench.folder / 'disk' / 'agpd'}"),
        "stopped",
        ("No space left", "disk/agpd"),
        "an error that names no file",
        inside=full_disk,
        afterwards=_kept_on_full_disk,
    ),
    Fault(
        "--policy.replay.root with a `merged` folder of somebody else",
        foreign_merged,
        "warned",
        ("could not be merged", "root"),
        "the folder is deleted",
        afterwards=_theirs_is_there,
    ),
    Fault(
        "checkpoints copied without their episodes",
        copied_without_episodes,
        "refused",
        ("--policy.replay.root", "copied from"),
        "resumed into the original's folder, without a word",
    ),
    Fault(
        "resumed with another success filter",
        lambda bench: [
            *damage.run("agpd/journal.json", lambda path: None)(bench),
            "--policy.collect.min_reward=-0.5",
        ],
        "warned",
        ("other settings", "collect.min_reward"),
        "adopted without a word",
    ),
    Fault(
        "repeated with another guidance",
        other_settings("--policy.guidance.pull=0.1"),
        "refused",
        ("another run", "guidance.pull", "--policy.replay.root"),
        "adopted without a word",
    ),
    Fault(
        "killed before the first checkpoint, the original command again",
        original_command,
        "named",
        ("holds an interrupted run", "--policy.replay.root="),
        "refused; neither command goes on",
    ),
    Fault(
        "resumed through a missing `last` link",
        without_last,
        "named",
        ("does not exist", "goes on with: lerobot-train", "000006"),
        "refused; neither command goes on",
    ),
]


# ---- signals ----


def signalled(number: int):
    """A signal once the first episode is on disk."""

    def of(bench: Bench) -> Inside:
        @contextmanager
        def inside(rank: int) -> Iterator[None]:
            def send() -> None:
                index = bench.output / "agpd" / "round-00000" / "rank-0.jsonl"
                while not index.exists():
                    time.sleep(0.001)
                os.kill(os.getpid(), number)

            if (
                signal.getsignal(signal.SIGINT) == signal.SIG_IGN
            ):  # as a shell starts what runs in its background
                signal.signal(signal.SIGINT, signal.default_int_handler)
            threading.Thread(target=send, daemon=True).start()
            yield

        return inside

    return of


def _goes_on(bench: Bench) -> list[str]:
    text = how_to_continue(bench.output, bench.output / "agpd")
    log = (bench.folder / "log" / "rank-0.log").read_text()
    return [] if text.partition(" by the command")[0] in log else [f"the log does not say: {text}"]


SIGNALS = [
    Fault(
        f"{number.name} in a round",
        lambda bench: bench.begin(),
        "stopped",
        (f"interrupted by {number.name}",),
        before,
        inside=signalled(number),
        afterwards=_goes_on,
    )
    for number, before in (
        (signal.SIGINT, "a traceback of 47 frames, no word about how to go on"),
        (signal.SIGTERM, "ends without a word"),
    )
]
