"""How an interrupted run goes on: which checkpoint is the newest complete one, and what to type."""

from __future__ import annotations

import json
import shlex
from itertools import count
from pathlib import Path

from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    OPTIMIZER_PARAM_GROUPS,
    OPTIMIZER_STATE,
    POLICY_POSTPROCESSOR_DEFAULT_NAME,
    POLICY_PREPROCESSOR_DEFAULT_NAME,
    PRETRAINED_MODEL_DIR,
    RNG_STATE,
    SCHEDULER_STATE,
    TRAINING_STATE_DIR,
    TRAINING_STEP,
)
from safetensors import SafetensorError, safe_open

from lerobot_agpd.progress import STATE_FILE

MODEL_FILES = (
    "config.json",
    "model.safetensors",
    TRAIN_CONFIG_NAME,
    STATE_FILE,
    f"{POLICY_PREPROCESSOR_DEFAULT_NAME}.json",
    f"{POLICY_POSTPROCESSOR_DEFAULT_NAME}.json",
)
STATE_FILES = (TRAINING_STEP, RNG_STATE, OPTIMIZER_PARAM_GROUPS, OPTIMIZER_STATE)
"""What LeRobot and this plugin write into the two folders of a checkpoint."""


# ---- checkpoints ----


def is_complete(checkpoint: Path) -> bool:
    """Whether every file of a checkpoint `<output_dir>/checkpoints/<step>` is there and readable."""
    if not all(map(_is_readable, _files(checkpoint))):
        return False
    config = json.loads((checkpoint / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME).read_text())
    return config.get("scheduler") is None or _is_readable(checkpoint / TRAINING_STATE_DIR / SCHEDULER_STATE)


def damaged_file(checkpoint: Path) -> Path | None:
    """The first file of a checkpoint that is there and cannot be read; None if there is none."""
    files = [*_files(checkpoint), checkpoint / TRAINING_STATE_DIR / SCHEDULER_STATE]
    return next((path for path in files if path.exists() and not _is_readable(path)), None)


def _files(checkpoint: Path) -> list[Path]:
    model, state = checkpoint / PRETRAINED_MODEL_DIR, checkpoint / TRAINING_STATE_DIR
    return [*(model / name for name in MODEL_FILES), *(state / name for name in STATE_FILES)]


def _is_readable(path: Path) -> bool:
    """Whether a JSON file parses, or the header of a safetensors file fits its size."""
    try:
        if path.suffix == ".json":
            json.loads(path.read_text())
        else:
            with safe_open(path, "pt"):
                pass
    except (OSError, ValueError, SafetensorError):
        return False
    return True


def newest_checkpoint(output_dir: Path) -> Path | None:
    """The complete checkpoint of a run with the most steps; None without any."""
    folder = output_dir / CHECKPOINTS_DIR
    steps = [path for path in folder.iterdir() if path.name.isdigit()] if folder.is_dir() else []
    newest_first = sorted(steps, key=lambda path: int(path.name), reverse=True)
    return next(filter(is_complete, newest_first), None)


# ---- what to type ----


def resume_flags(output_dir: Path, checkpoint: Path) -> str:
    """The flags of `lerobot-train` that continue a run from a checkpoint, in the folder that it is in now."""
    config = checkpoint / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME
    flags = [f"--config_path={config}", "--resume=true"]
    if config.is_file():
        written = Path(json.loads(config.read_text()).get("output_dir") or "")
        if written.resolve() != output_dir.resolve():
            flags.append(f"--output_dir={output_dir}")  # else LeRobot goes on writing where the run was begun
    return shlex.join(flags)


def repeat_flags(output_dir: Path, root: Path) -> str:
    """The flags that, with those of the original command, repeat a run that has no checkpoint."""
    names = (output_dir.with_name(f"{output_dir.name}-{number}") for number in count(2))
    unused = next(name for name in names if not name.exists())
    return shlex.join([f"--output_dir={unused}", f"--policy.replay.root={root}"])


def how_to_continue(output_dir: Path, root: Path) -> str:
    """What to type after an interruption, as the run's folder is now.

    Args:
        output_dir: of the run.
        root: folder of its collected episodes.
    """
    checkpoint = newest_checkpoint(output_dir)
    if checkpoint is not None:
        return f"it goes on with: lerobot-train {resume_flags(output_dir, checkpoint)}"
    return (
        "it has no complete checkpoint, so it goes on, with the episodes that it has collected, by the command that "
        f"started it with other values of two flags: {repeat_flags(output_dir, root)}"
    )


def announcement(output_dir: Path, root: Path) -> str:
    """What a run says when its first round begins."""
    last = output_dir / CHECKPOINTS_DIR / "last"
    return (
        f"collected episodes are kept in {root}. If this run is interrupted, it goes on with: lerobot-train "
        f"{resume_flags(output_dir, last)}; before its first checkpoint (--save_freq) by the same command with other "
        f"values of two flags: {repeat_flags(output_dir, root)}"
    )
