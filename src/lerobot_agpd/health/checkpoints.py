"""Examine the checkpoints of a run: which can be read, which is the newest, and how to go on from it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from huggingface_hub.constants import CONFIG_NAME, SAFETENSORS_SINGLE_FILE
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.policies import get_policy_class
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    OPTIMIZER_PARAM_GROUPS,
    OPTIMIZER_STATE,
    PRETRAINED_MODEL_DIR,
    RNG_STATE,
    TRAINING_STATE_DIR,
    TRAINING_STEP,
)
from safetensors import SafetensorError, safe_open

from lerobot_agpd.files import read_json
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.health.finding import Finding, Severity, is_broken
from lerobot_agpd.progress import STATE_FILE
from lerobot_agpd.trust import PROCESSOR_FILES, check_steps

NEEDED = (
    *(f"{PRETRAINED_MODEL_DIR}/{name}" for name in (CONFIG_NAME, TRAIN_CONFIG_NAME, SAFETENSORS_SINGLE_FILE)),
    *(f"{PRETRAINED_MODEL_DIR}/{name}" for name in PROCESSOR_FILES),
    *(
        f"{TRAINING_STATE_DIR}/{name}"
        for name in (TRAINING_STEP, RNG_STATE, OPTIMIZER_STATE, OPTIMIZER_PARAM_GROUPS)
    ),
)
"""Files without which a run cannot go on from a checkpoint."""


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that can be read.

    Attributes:
        folder: `<output_dir>/checkpoints/<step>`.
        train_config: settings of the run, as `lerobot-train` has saved them.
        counters: what AGPD has saved beside them; empty for another policy.
    """

    folder: Path
    train_config: dict[str, Any]
    counters: dict[str, Any]

    @property
    def step(self) -> int:
        """Training step."""
        return int(self.folder.name)

    @property
    def resume_command(self) -> str:
        """The command that continues the run from here."""
        config = self.folder / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME
        args = ["lerobot-train", f"--config_path={config}", "--resume=true"]
        recorded, output = self.train_config.get("output_dir"), self.folder.parents[1]
        if recorded is None or Path(recorded).resolve() != output.resolve():  # moved or copied
            args.append(f"--output_dir={output}")
        return shlex.join(args)


def examine_checkpoints(run: Path) -> tuple[list[Finding], Checkpoint | None]:
    """Findings about a run's checkpoints, and the newest that can be read."""
    root = run / CHECKPOINTS_DIR
    folders = sorted(
        (path for path in root.glob("*") if path.name.isdigit() and not path.is_symlink()), key=_step
    )
    if not folders:
        text = f"{root} holds no checkpoint yet: the run can be begun again, not continued"
        remedy = (
            "lerobot-train saves one every --save_freq steps; begin again with the command of the first time"
        )
        return [Finding(Severity.WARNING, "checkpoints", text, remedy)], None
    findings, readable = [], []
    for folder in folders:
        found = list(_examine(folder))
        findings += found
        if not is_broken(found):
            readable.append(folder)
    if not readable:
        return findings, None
    checkpoint = _read(readable[-1])
    for folder in readable:
        findings.append(Finding(Severity.OK, "checkpoints", f"{folder} can be read, its weights are finite"))
    return [*findings, *_link(root, folders, readable), *_continuation(checkpoint)], checkpoint


def _step(folder: Path) -> int:
    return int(folder.name)


def _read(folder: Path) -> Checkpoint:
    state = folder / PRETRAINED_MODEL_DIR / STATE_FILE
    return Checkpoint(
        folder,
        train_config=read_json(folder / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME),
        counters=read_json(state) if state.is_file() else {},
    )


# ---- one checkpoint ----


def _examine(folder: Path) -> Iterator[Finding]:
    """What is wrong with a checkpoint; nothing if it is as it should be."""
    remedy = "restore the file, or go on from another checkpoint and remove this folder"
    for name in NEEDED:
        if not (folder / name).is_file():
            yield Finding(Severity.BROKEN, "checkpoints", f"{folder / name} is missing", remedy)
    yield from _policy_package(folder / PRETRAINED_MODEL_DIR / CONFIG_NAME)
    for path in sorted(folder.rglob("*.json")):
        yield from _text(path, remedy)
    for path in sorted(folder.rglob("*.safetensors")):
        yield from _tensors(path, remedy)


def _policy_package(path: Path) -> Iterator[Finding]:
    """Import the package of a checkpoint's policy, whose processor steps are known only then."""
    try:
        policy_type = str(read_json(path).get("type"))
    except (ValueError, FileNotFoundError):
        return  # found by the others
    try:
        get_policy_class(policy_type)
    except Exception as error:  # whatever somebody else's package raises
        text = f"{path}: the policy type '{policy_type}' cannot be imported ({' '.join(str(error).split())[:200]})"
        remedy = "install the plugin that has it, or the extra of LeRobot that the error names"
        yield Finding(Severity.BROKEN, "checkpoints", text, remedy)


def _text(path: Path, remedy: str) -> Iterator[Finding]:
    """Whether a JSON file can be read, and a processor file names nothing but processor steps."""
    try:
        if path.name in PROCESSOR_FILES:
            check_steps(path)
        elif path.name == OPTIMIZER_PARAM_GROUPS:  # a list
            json.loads(path.read_text())
        else:
            read_json(path)
    except FlagError as error:
        yield Finding.of(Severity.BROKEN, "checkpoints", error)
    except ValueError as error:
        text = str(error) if str(path) in str(error) else f"{path} is damaged ({error})"
        yield Finding(Severity.BROKEN, "checkpoints", text.partition("; ")[0], remedy)


def _tensors(path: Path, remedy: str) -> Iterator[Finding]:
    """Whether all tensors of a file can be read, and hold numbers."""
    try:
        with safe_open(path, framework="pt") as tensors:
            bad = [key for key in tensors.keys() if _has_nan(tensors.get_tensor(key))]  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        yield Finding.of(Severity.BROKEN, "checkpoints", f"{path} is damaged ({error})", remedy)
        return
    if bad:
        text = f"{path} holds NaN in {len(bad)} tensors ({bad[0]}, ...)"
        remedy = (
            "the training has diverged: go on from an earlier checkpoint with a lower --policy.optimizer_lr"
        )
        yield Finding(Severity.BROKEN, "checkpoints", text, remedy)


def _has_nan(tensor: torch.Tensor) -> bool:
    return tensor.is_floating_point() and bool(torch.isnan(tensor).any())


# ---- all of them ----


def _link(root: Path, folders: list[Path], readable: list[Path]) -> Iterator[Finding]:
    """Whether `last` names the newest checkpoint."""
    link, newest = root / LAST_CHECKPOINT_LINK, readable[-1]
    remedy = shlex.join(["ln", "-sfn", newest.name, str(link)])
    if not link.is_symlink() and not link.exists():
        yield Finding(Severity.WARNING, "checkpoints", f"the link {link} is missing", remedy)
    elif not link.exists():
        yield Finding(Severity.WARNING, "checkpoints", f"the link {link} leads nowhere", remedy)
    elif link.resolve() != newest.resolve():
        text = f"the link {link} leads to {link.resolve().name}; the newest that can be read is {newest.name}"
        yield Finding(Severity.WARNING, "checkpoints", text, remedy)
    if newest != folders[-1]:
        text = f"the newest checkpoint, {folders[-1].name}, is damaged; {newest.name} is the newest that can be read"
        yield Finding(Severity.WARNING, "checkpoints", text, "go on from there with the command below")


def _continuation(checkpoint: Checkpoint) -> Iterator[Finding]:
    """How the run goes on, and whether what it needs is still there."""
    config = checkpoint.train_config
    steps = config.get("steps")
    if isinstance(steps, int) and checkpoint.step >= steps:
        text = f"the run is complete ({checkpoint.step} of {steps} steps)"
        remedy = f"to train longer: {checkpoint.resume_command} --steps=<more>"
        yield Finding(Severity.OK, "continue", text, remedy)
    else:
        text = f"the run has a checkpoint of step {checkpoint.step} of {steps}"
        yield Finding(Severity.OK, "continue", text, f"to go on: {checkpoint.resume_command}")
    policy = config.get("policy") or {}
    needed = {
        "--dataset.root": (config.get("dataset") or {}).get("root"),
        "--policy.teacher.path": (policy.get("teacher") or {}).get("path"),
    }
    for flag, value in needed.items():
        if value and Path(value).is_absolute() and not Path(value).exists():
            text = f"{flag}={value} of the run is not there any more"
            yield Finding(Severity.BROKEN, "continue", text, f"name its new place: add {flag}=<folder>")
