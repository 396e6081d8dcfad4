"""Start, resume or skip a run: what its folder says, and the command that continues it.

<output>/<task>/<method>/seed-<n>/
    command.json       flags the run was started with
    starts.jsonl       every start: when, from which step, how long, with which packages, teacher and demonstrations
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
from collections.abc import Sequence
from dataclasses import dataclass
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

from lerobot_agpd.files import read_json, write_json, write_text
from lerobot_agpd.progress import REPLAY_FOLDER, STATE_FILE
from lerobot_agpd.rollout.report import read_reports
from lerobot_agpd.studies.provenance import inputs, provenance
from lerobot_agpd.studies.runs import Run

COMMAND = "command.json"
STARTS = "starts.jsonl"
TRAIN_LOG = "train.log"

Start = dict[str, Any]
"""One line of `starts.jsonl`."""


@dataclass(frozen=True)
class Progress:
    """How far a run's training is: the step of its last complete checkpoint, of all its steps."""

    step: int
    steps: int

    @property
    def finished(self) -> bool:
        """Whether the last step has its checkpoint."""
        return self.step >= self.steps


def last_checkpoint(run: Run) -> Path | None:
    """The last complete checkpoint; LeRobot links it once it is all written."""
    link = run.output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK
    return link.resolve() if link.exists() else None


def progress(run: Run) -> Progress | None:
    """How far a run is; None without a checkpoint."""
    checkpoint = last_checkpoint(run)
    if checkpoint is None:
        return None
    config = read_json(checkpoint / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME)
    # LeRobot renamed the function that reads this file after 0.6.1; the file and its "step" stayed.
    state = read_json(checkpoint / TRAINING_STATE_DIR / TRAINING_STEP)
    return Progress(int(state["step"]), int(config["steps"]))


def is_trained(run: Run) -> bool:
    """Whether the last step of a run has its checkpoint."""
    reached = progress(run)
    return reached is not None and reached.finished


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
    args = [*args, f"--output_dir={run.output_dir}"]
    if (run.folder / REPLAY_FOLDER).is_dir():
        args.append(f"--policy.replay.root={run.folder / REPLAY_FOLDER}")
    return ["lerobot-train", *args]


def check_same_command(run: Run) -> None:
    """Refuse a run that was started with other flags, or is to be resumed with other files behind them.

    Raises:
        ValueError: naming what differs.
    """
    path = run.folder / COMMAND
    if run.policy or not path.is_file():
        return
    before = read_json(path)["flags"]
    changes = [
        f"{name}: {before.get(name, '-')} -> {run.flags.get(name, '-')}"
        for name in sorted({*before, *run.flags})
        if before.get(name, "-") != run.flags.get(name, "-")
    ]
    if changes:
        raise ValueError(
            f"{run.folder} was started with other flags ({'; '.join(changes)}); restore them, choose another "
            "--output, or remove the folder to train anew"
        )
    if not is_trained(run):
        _check_same_inputs(run)


def _check_same_inputs(run: Run) -> None:
    starts = read_starts(run)
    before = starts[-1]["inputs"] if starts else {}
    changed = [name for name, value in inputs(run.flags).items() if before.get(name, value) != value]
    if changed:
        raise ValueError(
            f"{run.folder} was begun with other files than now lie at its paths ({', '.join(changed)}); put them back, "
            "choose another --output, or remove the folder to train anew"
        )


def prepare(run: Run) -> None:
    """Make a run's folder ready: a training that never reached a checkpoint starts anew, keeping its rounds."""
    run.folder.mkdir(parents=True, exist_ok=True)
    write_json(run.folder / COMMAND, {"flags": dict(run.flags)})
    if last_checkpoint(run) is None and run.output_dir.exists():
        rounds = run.output_dir / REPLAY_FOLDER
        if any(rounds.glob("round-*")):
            rounds.rename(run.folder / REPLAY_FOLDER)
        shutil.rmtree(run.output_dir)


class StartLog:
    """The starts of a run's training; one that was killed lasted until the last line of its log."""

    def __init__(self, run: Run):
        self.run = run
        self.entries = read_starts(run)
        if self.entries and "seconds" not in self.entries[-1]:
            began, log = self.entries[-1]["began"], run.folder / TRAIN_LOG
            alive = log.stat().st_mtime if log.exists() else began
            self.entries[-1] |= {"seconds": max(0.0, alive - began), "interrupted": True}

    def begin(self, command: Sequence[str], threads: int) -> None:
        """Note a start."""
        reached = progress(self.run)
        self.entries.append(
            {
                "began": time.time(),
                "command": list(command),
                "threads": threads,
                "from_step": reached.step if reached else 0,
                "rounds_adopted": _rounds_adopted(self.run),
                "inputs": inputs(self.run.flags),
                **provenance(),
            }
        )
        self._write()

    def end(self, returncode: int) -> None:
        """Note its end."""
        self.entries[-1] |= {"seconds": time.time() - self.entries[-1]["began"], "returncode": returncode}
        self._write()

    def _write(self) -> None:
        lines = [json.dumps(entry) + "\n" for entry in self.entries]
        write_text(self.run.folder / STARTS, "".join(lines))


def _rounds_adopted(run: Run) -> int:
    """Rounds that were finished after the last checkpoint: the resumed student meets them earlier."""
    finished = len(read_reports(replay_folder(run)))
    checkpoint = last_checkpoint(run)
    state = checkpoint / PRETRAINED_MODEL_DIR / STATE_FILE if checkpoint else None
    return finished - (read_json(state)["rounds"] if state and state.is_file() else 0)


def read_starts(run: Run) -> list[Start]:
    """Every start of a run's training, in order."""
    path = run.folder / STARTS
    return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
