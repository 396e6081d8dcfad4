"""Start, resume or skip a run: what its folder says, and the command that continues it.

<output>/<task>/<method>/seed-<n>/
    command.json       flags the run was started with
    starts.jsonl       every start: when, from which step, how long, with which packages, teacher and demonstrations
    train/             output folder of lerobot-train
    agpd/              collected episodes, once a run without checkpoint had to start anew; else train/agpd
    train.log  evaluate.log
    evaluations/       one file per evaluated checkpoint
    run.json           the result
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.common.train_utils import load_training_step
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
)

from lerobot_agpd.comparison.files import read_json, write_json, write_text
from lerobot_agpd.comparison.provenance import inputs, provenance
from lerobot_agpd.comparison.runs import Run
from lerobot_agpd.distill.state import REPLAY_FOLDER, STATE_FILE

COMMAND = "command.json"
STARTS = "starts.jsonl"
TRAIN_LOG = "train.log"
MODULES = {
    "lerobot-train": "lerobot.scripts.lerobot_train",
    "lerobot-agpd-compare": "lerobot_agpd.cli.compare",
}


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
    config = json.loads((checkpoint / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME).read_text())
    return Progress(load_training_step(checkpoint / TRAINING_STATE_DIR), int(config["steps"]))


def replay_parent(run: Run) -> Path:
    """The folder whose `agpd` holds the run's collected episodes."""
    return run.folder if (run.folder / REPLAY_FOLDER).is_dir() else run.output_dir


def train_command(run: Run) -> list[str]:
    """The command that starts or resumes a run, as a user would type it."""
    checkpoint = last_checkpoint(run)
    if checkpoint is None:
        words = run.words
    else:
        config = (
            run.output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME
        )
        words = [f"--config_path={config}", "--resume=true"]
    words = [*words, f"--output_dir={run.output_dir}"]
    if (run.folder / REPLAY_FOLDER).is_dir():
        words.append(f"--policy.replay.root={run.folder / REPLAY_FOLDER}")
    return ["lerobot-train", *words]


def check_same_command(run: Run) -> None:
    """Refuse a run that was started with other flags, or is to be resumed with other files behind them.

    Raises:
        ValueError: naming what differs.
    """
    path = run.folder / COMMAND
    if run.policy or not path.is_file():
        return
    known = read_json(path)["flags"]
    differing = sorted(
        name for name in {*known, *run.flags} if known.get(name, "-") != run.flags.get(name, "-")
    )
    if differing:
        changes = [f"{name}: {known.get(name, '-')} -> {run.flags.get(name, '-')}" for name in differing]
        raise ValueError(
            f"{run.folder} was started with other flags ({'; '.join(changes)}); restore them, choose another "
            "--output, or remove the folder to train anew"
        )
    reached = progress(run)
    if not (reached is not None and reached.finished):
        _check_same_inputs(run)


def _check_same_inputs(run: Run) -> None:
    starts = read_starts(run)
    known = starts[-1].get("inputs", {}) if starts else {}
    changed = [
        name for name, fingerprint in inputs(run.flags).items() if known.get(name, fingerprint) != fingerprint
    ]
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
    """The starts of a run's training; the time of one that was killed is known from the last sign of life."""

    def __init__(self, run: Run):
        """Open the log, and close the entry of a start that never ended."""
        self.path = run.folder / STARTS
        self.log = run.folder / TRAIN_LOG
        self.entries = read_starts(run)
        if self.entries and "seconds" not in self.entries[-1]:
            began = self.entries[-1]["began"]
            alive = self.log.stat().st_mtime if self.log.exists() else began
            self.entries[-1] |= {"seconds": max(0.0, alive - began), "interrupted": True}

    def begin(self, run: Run, command: Sequence[str], threads: int) -> None:
        """Note a start."""
        rounds = len(list((replay_parent(run) / REPLAY_FOLDER).glob("round-[0-9][0-9][0-9]")))
        reached, checkpoint = progress(run), last_checkpoint(run)
        state = checkpoint / PRETRAINED_MODEL_DIR / STATE_FILE if checkpoint else None
        used = read_json(state)["rounds"] if state and state.is_file() else 0
        self.entries.append(
            {
                "began": time.time(),
                "command": list(command),
                "threads": threads,
                "from_step": reached.step if reached else 0,
                "rounds_adopted": rounds
                - used,  # finished after the checkpoint: the student meets them earlier
                "inputs": inputs(run.flags),
                **provenance(),
            }
        )
        self._write()

    def end(self, returncode: int) -> None:
        """Note its end."""
        self.entries[-1] |= {"seconds": time.time() - self.entries[-1]["began"], "returncode": returncode}
        self._write()

    def _write(self) -> None:
        write_text(self.path, "".join(json.dumps(entry) + "\n" for entry in self.entries))


def read_starts(run: Run) -> list[dict[str, Any]]:
    """Every start of a run's training, in order."""
    path = run.folder / STARTS
    return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []


def executable(command: Sequence[str]) -> list[str]:
    """A command as this Python runs it, whichever scripts the shell would find."""
    return [sys.executable, "-m", MODULES[command[0]], *command[1:]]
