"""What to say before LeRobot refuses a `lerobot-train` command: its own message names neither path nor way out.

LeRobot takes a missing checkpoint for a repository of the Hub, refuses an output folder that exists, and opens
demonstrations and checkpoints before it builds a policy.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot.utils.constants import CHECKPOINTS_DIR, HF_LEROBOT_HOME

from lerobot_agpd.continuation import damaged_file, how_to_continue
from lerobot_agpd.health.dataset import damage_of_dataset
from lerobot_agpd.progress import REPLAY_FOLDER


def advice(command: Sequence[str]) -> list[str]:
    """What is wrong with a command, and what to do; empty for a command of another program.

    Args:
        command: the program and its flags.
    """
    if Path(command[0]).stem.replace("_", "-") != "lerobot-train":
        return []
    flags = {
        name: _value(command, f"--{name}")
        for name in ("config_path", "output_dir", "resume", "dataset.root", "dataset.repo_id")
    }
    resumes = (flags["resume"] or "").lower() == "true"
    config_path = Path(flags["config_path"]) if flags["config_path"] else None
    found = _of_checkpoint(config_path) if resumes else _of_output(flags["output_dir"])
    return [*found, *_of_demonstrations(flags, config_path)]


# ---- checkpoints ----


def _of_checkpoint(config_path: Path | None) -> Iterator[str]:
    """A checkpoint `<run>/checkpoints/<step>/pretrained_model/train_config.json` that cannot be resumed."""
    parents = config_path.parents if config_path else ()
    folder = next((path for path in parents if path.name == CHECKPOINTS_DIR), None)
    if config_path is None or folder is None or not folder.parent.is_dir():
        return
    run = folder.parent
    damaged = damaged_file(config_path.parents[1])
    if not config_path.exists():
        problem = f"--config_path={config_path} does not exist. If the run of {run} was interrupted"
    elif damaged is not None:
        problem = f"--config_path={config_path}: {damaged} is damaged. If the run of {run} was interrupted"
    else:
        return
    yield f"{problem}, {how_to_continue(run, run / REPLAY_FOLDER)}"


def _of_output(output_dir: str | None) -> Iterator[str]:
    """An output folder that a new run cannot have."""
    if output_dir and (Path(output_dir) / REPLAY_FOLDER).is_dir():
        text = how_to_continue(Path(output_dir), Path(output_dir) / REPLAY_FOLDER)
        yield f"--output_dir={output_dir} holds an interrupted run; {text}"


# ---- demonstrations ----


def _of_demonstrations(flags: Mapping[str, str | None], config_path: Path | None) -> Iterator[str]:
    """Demonstrations on this machine whose files cannot be read."""
    saved = _dataset(config_path)
    root, repo_id = (flags[f"dataset.{name}"] or saved.get(name) for name in ("root", "repo_id"))
    folder = Path(root) if root else HF_LEROBOT_HOME / repo_id if repo_id else None
    if folder is None or not folder.is_dir():
        return  # LeRobot will fetch them
    damage = damage_of_dataset(folder)
    if damage is not None:
        flag = f"--dataset.root={root}" if root else f"--dataset.repo_id={repo_id}"
        yield f"{flag}: {damage.text}; {damage.remedy} (lerobot-agpd-doctor --dataset={folder} examines all of it)"


def _dataset(config_path: Path | None) -> dict[str, Any]:
    """The dataset that a JSON configuration names."""
    try:
        content = json.loads(config_path.read_text()) if config_path else {}
    except (OSError, ValueError):
        return {}
    dataset = content.get("dataset") if isinstance(content, dict) else None
    return dataset if isinstance(dataset, dict) else {}


# ---- flags ----


def _value(command: Sequence[str], flag: str) -> str | None:
    """Value of a flag, written `--flag=value` or `--flag value`; the last one counts."""
    value = None
    for position, word in enumerate(command):
        if word.startswith(f"{flag}="):
            value = word.removeprefix(f"{flag}=")
        elif word == flag and position + 1 < len(command):
            value = command[position + 1]
    return value
