"""The faults: data, files, environments, disks, runs and signals."""

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

CLONING = ("--policy.collect.every=0",)
DATA, INFO, STATS = "data/*/*.parquet", "meta/info.json", "meta/stats.json"
MODEL = "checkpoints/000003/pretrained_model/"
STATE = "checkpoints/000003/training_state/"

# ---- demonstrations and teachers ----

NUMBERS = [
    Fault(
        "NaN in a demonstration's state",
        damage.demonstrations(DATA, damage.number("observation.state", float("nan"))),
        "refused",
        ("--dataset", "'observation.state'", "episode 1, frame 2"),
        "accepted; the loss is NaN from the first step, exit 0",
    ),
    Fault(
        "infinity in a demonstration's environment state",
        damage.demonstrations(DATA, damage.number("observation.environment_state", float("inf"))),
        "refused",
        ("--dataset", "'observation.environment_state'", "episode 1, frame 2"),
        "accepted; the loss is NaN from the first step, exit 0",
    ),
    Fault(
        "NaN in a demonstration's action",
        damage.demonstrations(DATA, damage.number("action", float("nan"))),
        "refused",
        ("--dataset", "'action'", "episode 1, frame 2"),
        "refused with a text about processors",
    ),
    Fault(
        "NaN in the demonstrations' statistics",
        damage.demonstrations(STATS, damage.statistic),
        "refused",
        ("--dataset", "'std' of 'observation.state'", "recompute_stats"),
        "accepted; everything is NaN, exit 0",
    ),
    Fault(
        "demonstrations without statistics",
        damage.demonstrations(STATS, damage.remove),
        "refused",
        ("--dataset", "no statistics", "recompute_stats"),
        "trains on values that are not normalized",
    ),
    Fault(
        "demonstrations at 25 Hz, environment at 10",
        damage.demonstrations(INFO, damage.rate),
        "refused",
        ("25 frames per second", "--env.fps) runs at 10"),
        "trains on two time scales",
    ),
    Fault(
        "NaN in a teacher's weights, no collection",
        damage.teacher("model.safetensors", damage.weights, *CLONING),
        "refused",
        ("--policy.teacher.path", "not finite"),
        "exit 0, everything is NaN",
    ),
]

BARE = 'a bare JSONDecodeError, "Cannot reach the Hub" or BadZipFile, without path or remedy'
"""What was said of about twelve kinds of damaged files."""

HOW = {"truncated": damage.truncate, "missing": damage.remove, "a garbled line in": damage.garble}

DEMONSTRATIONS = {
    "info.json": INFO,
    "stats.json": STATS,
    "index of episodes": "meta/episodes/*/*.parquet",
    "frames": DATA,
    "tasks": "meta/tasks.parquet",
}

JOURNAL = {  # file, damage: what the line must say
    ("agpd/journal.json", "truncated"): ("journal.json", "restore"),
    ("agpd/round-00000/rank-0.jsonl", "a garbled line in"): ("rank-0.jsonl", "delete the line"),
    ("agpd/round-00001/report.json", "truncated"): ("report.json", "restore"),
    ("agpd/round-00000/report.json", "missing"): ("round-00000", "restore"),
    ("agpd/round-00000", "missing"): ("round-00000", "restore"),
    ("agpd/round-00000/*.npy", "truncated"): (".npy", "delete the line"),
    ("agpd/round-00000/*.npy", "missing"): (".npy", "delete the line"),
    (MODEL + "agpd_state.json", "truncated"): ("agpd_state.json", "earlier checkpoint"),
    (MODEL + "agpd_state.json", "missing"): ("agpd_state.json", "--policy.path"),
}

CHECKPOINT = {  # files that LeRobot reads: outcome
    MODEL + "model.safetensors": "refused",
    MODEL + "config.json": "refused",
    MODEL + "policy_preprocessor.json": "refused",
    MODEL + "train_config.json": "named",
    STATE + "optimizer_state.safetensors": "refused",
    STATE + "training_step.json": "refused",
}

TEACHER = {
    ("truncated", "config.json"): (damage.truncate, "restore", BARE),
    ("truncated", "model.safetensors"): (damage.truncate, "restore", BARE),
    ("truncated", "policy_preprocessor.json"): (damage.truncate, "restore", BARE),
    ("truncated", "*normalizer*.safetensors"): (damage.truncate, "restore", BARE),
    ("missing", "model.safetensors"): (damage.remove, "is missing", BARE),
    ("pickled", "model.safetensors"): (damage.pickled, "never read", ""),
    ("missing", "policy_preprocessor.json"): (
        damage.remove,
        "migrate_policy_normalization",
        "LeRobot's traceback at the first step",
    ),
    ("a field of another version in", "config.json"): (
        damage.foreign("of_another_version"),
        "another version",
        '"neither a folder with a policy\'s config.json nor a Hub repository"',
    ),
    ("subprocess.Popen in", "policy_postprocessor.json"): (
        damage.program,
        "subprocess.Popen",
        "the program is run",
    ),
}

FILES = [
    *(
        Fault(
            f"demonstrations: {how} {name}",
            damage.demonstrations(pattern, HOW[how]),
            "named",
            ("--dataset.root={demos}", "lerobot-agpd-doctor"),
            BARE,
        )
        for name, pattern in DEMONSTRATIONS.items()
        for how in ("truncated", "missing")
        if (name, how) != ("stats.json", "missing")  # among the numbers
    ),
    *(
        Fault(
            f"teacher: {what} {pattern}",
            damage.teacher(pattern, how),
            "refused",
            ("{teacher}", remedy),
            before,
            afterwards=lambda bench: ["the program was run"] if (bench.teacher / "ran").exists() else [],
        )
        for (what, pattern), (how, remedy, before) in TEACHER.items()
    ),
    *(
        Fault(f"run: {how} {pattern}", damage.run(pattern, HOW[how]), "refused", names, BARE)
        for (pattern, how), names in JOURNAL.items()
    ),
    *(
        Fault(
            f"run: truncated {pattern}",
            damage.run(pattern, damage.truncate),
            outcome,
            (f"{Path(pattern).name} is damaged", "goes on with: lerobot-train", "000006"),
            BARE,
        )
        for pattern, outcome in CHECKPOINT.items()
    ),
]

# ---- environments ----


def environment(fault: str, episodes: list[int], *more: str):
    """A new run in the faulty environment."""
    flags = (f"--env.fault={fault}", f"--env.episodes={episodes}".replace(" ", ""), *more)
    return lambda bench: bench.begin("--env.type=faulty_point", *flags)


ALL = list(range(100))
WORKERS = "--policy.collect.use_async_envs=true"

ENVIRONMENTS = [
    Fault(
        "NaN in an observation of one episode",
        environment("nan_state", [2]),
        "dropped",
        ("episodes are dropped", "'observation.state' at step 2 is not finite", "--env.*"),
        "the episode is kept, all 48 tensors of the student become NaN, exit 0",
    ),
    Fault(
        "NaN in a reward of one episode",
        environment("nan_reward", [2]),
        "dropped",
        ("episodes are dropped", "'next.reward' at step 1 is not finite", "--env.*"),
        "a TypeError in the report blocks the round and every resume",
    ),
    Fault(
        "NaN in the observations of all episodes",
        environment("nan_state", ALL),
        "stopped",
        ("4 of 4 episodes are dropped", "'observation.state'", "--env.*", "--resume=true"),
        "",
    ),
    Fault(
        "an environment in a worker process hangs",
        environment("hangs", [2], WORKERS, "--policy.collect.step_timeout=2"),
        "dropped",
        ("no answer from the environment in 2 s", "--policy.collect.step_timeout"),
        "the run waits for ever, without a word",
    ),
    Fault(
        "an environment in the run's own process is slow",
        environment("slow", [2], "--policy.collect.step_timeout=1"),
        "warned",
        ("--policy.collect.step_timeout", "The round waits", WORKERS),
        "the run waits, without a word",
    ),
    Fault(
        "a worker process dies",
        environment("dies", [2], WORKERS),
        "dropped",
        ("worker process has ended", "dropped"),
        "",
    ),
    Fault(
        "an episode never ends",
        environment("never_ends", ALL, "--policy.collect.max_episode_steps=30"),
        "warned",
        ("cut off after 30 steps", "--policy.collect.max_episode_steps"),
        "the run waits for ever, without a word",
    ),
    Fault(
        "success at the first step",
        environment("at_once", ALL),
        "warned",
        ("all 4 were solved at the start", "at its first step"),
        "the warning blames a weak teacher",
    ),
    Fault(
        "never a success",
        environment("never", ALL),
        "warned",
        ("kept no episode", "--policy.collect.min_reward"),
        "guidance grows from round to round",
        afterwards=lambda bench: _strength_grew(bench),
    ),
]


def _strength_grew(bench: Bench) -> list[str]:
    reports = EpisodeJournal(bench.output / "agpd").reports()
    grew = any(report["next_strength"] > report["strength"] for report in reports)
    return ["the strength of guidance has grown"] if grew else []


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

FAULTS = {
    "numbers": NUMBERS,
    "files": FILES,
    "environments": ENVIRONMENTS,
    "runs": RUNS,
    "signals": SIGNALS,
}
