"""How an interrupted run goes on: which checkpoint is the newest complete one, and what to type."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
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

from lerobot_agpd.progress import REPLAY_FOLDER, STATE_FILE

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
    model, state = checkpoint / PRETRAINED_MODEL_DIR, checkpoint / TRAINING_STATE_DIR
    files = [*(model / name for name in MODEL_FILES), *(state / name for name in STATE_FILES)]
    if not all(map(_is_readable, files)):
        return False
    has_schedule = json.loads((model / TRAIN_CONFIG_NAME).read_text()).get("scheduler") is not None
    return not has_schedule or _is_readable(state / SCHEDULER_STATE)


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


# ---- commands that LeRobot refuses ----


def advice(command: Sequence[str]) -> str | None:
    """What a refused `lerobot-train` command of an interrupted run should have been; None for any other command.

    LeRobot takes a missing checkpoint for a repository of the Hub, and refuses an output folder that exists, without a
    word about the way out.

    Args:
        command: the program and its flags.
    """
    if Path(command[0]).stem.replace("_", "-") != "lerobot-train":
        return None
    config_path, output_dir = (_value(command, flag) for flag in ("--config_path", "--output_dir"))
    resumes = (_value(command, "--resume") or "").lower() == "true"
    if (
        resumes
        and config_path
        and not Path(config_path).exists()
        and CHECKPOINTS_DIR in Path(config_path).parts
    ):
        parents = Path(config_path).parents
        run = next(path for path in parents if path.name == CHECKPOINTS_DIR).parent
        if run.is_dir():
            how = how_to_continue(run, run / REPLAY_FOLDER)
            return f"--config_path={config_path} does not exist. If the run of {run} was interrupted, {how}"
    if not resumes and output_dir and (Path(output_dir) / REPLAY_FOLDER).is_dir():
        run = Path(output_dir)
        return (
            f"--output_dir={output_dir} holds an interrupted run; {how_to_continue(run, run / REPLAY_FOLDER)}"
        )
    return None


def _value(command: Sequence[str], flag: str) -> str | None:
    """Value of a flag, written `--flag=value` or `--flag value`; the last one counts."""
    value = None
    for position, word in enumerate(command):
        if word.startswith(f"{flag}="):
            value = word.removeprefix(f"{flag}=")
        elif word == flag and position + 1 < len(command):
            value = command[position + 1]
    return value
