"""Start, resume or skip a run: what its folder says, and the command that continues it.

<output>/<task>/<method>/seed-<n>/
    starts.jsonl       every start: flags, when, from which step, how long, with which packages, teacher and demonstrations
    train/             output folder of lerobot-train
    agpd/              collected episodes, once a run without checkpoint had to start anew; else train/agpd
    train.log  evaluate.log
    evaluations/       one file per evaluation of a checkpoint
    run.json           the result
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
    TRAINING_STEP,
)

from lerobot_agpd.files import read_json, write_text
from lerobot_agpd.flag_checks import require
from lerobot_agpd.progress import REPLAY_FOLDER
from lerobot_agpd.studies.provenance import inputs, provenance
from lerobot_agpd.studies.runs import Run

STARTS = "starts.jsonl"
TRAIN_LOG = "train.log"

Start = dict[str, Any]
"""One line of `starts.jsonl`."""


def last_checkpoint(run: Run) -> Path | None:
    """The last complete checkpoint; LeRobot links it once it is all written."""
    link = run.output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK
    return link.resolve() if link.exists() else None


def last_step(run: Run) -> int:
    """Training step of the last checkpoint; 0 without one."""
    checkpoint = last_checkpoint(run)
    # LeRobot renamed the function that reads this file after 0.6.1; the file and its "step" stayed.
    return int(read_json(checkpoint / TRAINING_STATE_DIR / TRAINING_STEP)["step"]) if checkpoint else 0


def is_trained(run: Run) -> bool:
    """Whether the last step of a run has its checkpoint."""
    checkpoint = last_checkpoint(run)
    if checkpoint is None:
        return False
    config = read_json(checkpoint / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME)
    return last_step(run) >= int(config["steps"])


def replay_folder(run: Run) -> Path:
    """The folder of the run's collected episodes."""
    own = run.folder / REPLAY_FOLDER
    return own if own.is_dir() else run.output_dir / REPLAY_FOLDER


def train_command(run: Run) -> list[str]:
    """The command that starts or resumes a run, as a user would type it."""
    args = run.args
    if last_checkpoint(run) is not None:
        checkpoint = run.output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK
        args = [f"--config_path={checkpoint / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME}", "--resume=true"]
    if (run.folder / REPLAY_FOLDER).is_dir():
        args = [*args, f"--policy.replay.root={run.folder / REPLAY_FOLDER}"]
    return ["lerobot-train", *args, f"--output_dir={run.output_dir}"]


def check_same_command(run: Run) -> None:
    """Refuse a run that was started with other flags, or is to be resumed with other files behind them.

    Raises:
        FlagError: naming what differs.
    """
    starts = read_starts(run)
    if not starts:
        return
    remedy = "choose another --output, or remove the folder to train anew"
    before = starts[-1]["flags"]
    changes = [
        f"{name}: {before.get(name, '-')} -> {run.flags.get(name, '-')}"
        for name in sorted({*before, *run.flags})
        if before.get(name, "-") != run.flags.get(name, "-")
    ]
    require(
        not changes,
        f"{run.folder} was started with other flags ({'; '.join(changes)}); restore them, {remedy}",
    )
    files = starts[-1]["inputs"]
    changed = [name for name, value in inputs(run.flags).items() if files.get(name, value) != value]
    require(
        not changed or is_trained(run),
        f"{run.folder} was begun with other files than now lie at its paths ({', '.join(changed)}); put them back, {remedy}",
    )


def prepare(run: Run) -> None:
    """Make a run's folder ready: a training that never reached a checkpoint starts anew, keeping its episodes."""
    run.folder.mkdir(parents=True, exist_ok=True)
    if last_checkpoint(run) is None and run.output_dir.exists():
        episodes = run.output_dir / REPLAY_FOLDER
        if any(episodes.glob("round-*")):
            episodes.rename(run.folder / REPLAY_FOLDER)
        shutil.rmtree(run.output_dir)


@contextmanager
def noted_start(run: Run, command: Sequence[str], threads: int) -> Iterator[None]:
    """Note a start of a run's training, and how long it took; one that was killed lasted until its log's last line."""
    starts = read_starts(run)
    if starts and "seconds" not in starts[-1]:
        began, log = starts[-1]["began"], run.folder / TRAIN_LOG
        alive = log.stat().st_mtime if log.exists() else began
        starts[-1] |= {"seconds": max(0.0, alive - began), "interrupted": True}
    start: Start = {
        "flags": dict(run.flags),
        "began": time.time(),
        "command": list(command),
        "threads": threads,
        "from_step": last_step(run),
        "inputs": inputs(run.flags),
        **provenance(),
    }
    _write_starts(run, [*starts, start])
    try:
        yield
    finally:
        start["seconds"] = time.time() - start["began"]
        _write_starts(run, [*starts, start])


def _write_starts(run: Run, starts: Sequence[Start]) -> None:
    write_text(run.folder / STARTS, "".join(json.dumps(start) + "\n" for start in starts))


def read_starts(run: Run) -> list[Start]:
    """Every start of a run's training, in order."""
    path = run.folder / STARTS
    return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
