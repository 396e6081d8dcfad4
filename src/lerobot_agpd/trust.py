"""What a checkpoint of somebody else may do here: its processor files are checked before anything is built.

LeRobot imports whatever class a processor file names and calls it with the file's arguments
(`DataProcessorPipeline.from_pretrained`), so that loading a stranger's checkpoint runs a stranger's program. Only
processor steps of LeRobot and of installed plugins are admitted here. Weights and statistics are safetensors, which
hold nothing but numbers; pickled ones are never read.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.configs import PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
)
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

from lerobot_agpd.files import read_json
from lerobot_agpd.flag_checks import FlagError, require
from lerobot_agpd.weights import stored_shapes

Processors = tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]

PROCESSOR_FILES = (f"{POLICY_PREPROCESSOR_DEFAULT_NAME}.json", f"{POLICY_POSTPROCESSOR_DEFAULT_NAME}.json")

OWN_PACKAGES = ("lerobot", "lerobot_agpd")

PLUGIN_PREFIXES = (
    "lerobot_policy_",
    "lerobot_env_",
    "lerobot_robot_",
    "lerobot_camera_",
    "lerobot_teleoperator_",
)
"""Distributions that LeRobot imports as plugins (`register_third_party_plugins`)."""

PICKLED = ("*.bin", "*.pt", "*.pth", "*.ckpt", "*.pkl")

RESTORE = "restore the file from where the checkpoint came from, or name another checkpoint"

CODE_FROM_HUB: Mapping[str, tuple[str, ...]] = {
    "ActionTokenizerProcessorStep": ("action_tokenizer_name", "paligemma_tokenizer_name"),
    "GrootN17VLMEncodeStep": ("model_name",),
    "RobometerEncoderProcessorStep": ("base_model_id",),
    "TOPRewardEncoderProcessorStep": ("vlm_name",),
    "GaussianActorConfig": ("vision_encoder_name",),
    "GrootConfig": ("base_model_path",),
    "PI0FastConfig": ("action_tokenizer_name", "text_tokenizer_name"),
    "WallXConfig": ("action_tokenizer_path",),
}
"""Classes of LeRobot that run the code of a Hub repository (transformers' `trust_remote_code`), and the settings that
name it. Their own defaults and KNOWN_CODE are admitted."""

KNOWN_CODE = ("lerobot/fast-action-tokenizer", "physical-intelligence/fast")


def load_processors(path: str | Path, config: PreTrainedConfig) -> Processors:
    """Build the processors saved with a checkpoint, after checking their files and their statistics.

    Args:
        path: checkpoint folder or Hub repository.
        config: the policy's; they work on its device, and a Hub repository is read at its `pretrained_revision`.

    Raises:
        FlagError: if a file names a step that is not admitted, or the checkpoint has no processor files.
        ValueError: naming the file, if one is damaged.
    """
    get_policy_class(config.type)  # registers the processor steps of its package
    revision = config.pretrained_revision
    for name in PROCESSOR_FILES:
        file = _processor_file(path, name, revision)
        if not Path(path).is_dir():
            revision = file.parent.name  # the commit: what is built below is what was checked
        for statistics in check_steps(file):
            if Path(path).is_dir() or statistics.exists():  # else LeRobot will fetch them from the Hub
                stored_shapes(statistics, RESTORE)
    return make_pre_post_processors(
        config,
        pretrained_path=str(path),
        pretrained_revision=revision,
        preprocessor_overrides={"device_processor": {"device": config.device}},
    )


def check_steps(file: Path) -> list[Path]:
    """Refuse a processor file with a step that is not admitted.

    Returns:
        The files of statistics that it names.

    Raises:
        FlagError: naming file, step and class.
        ValueError: if the file is damaged.
    """
    steps = read_json(file, RESTORE).get("steps")
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        raise ValueError(f"{file} is damaged (its 'steps' are no list of objects); {RESTORE}")
    for number, entry in enumerate(steps):
        step_class = _step_class(entry)
        named = entry.get("registry_name", entry.get("class"))
        if step_class is None:
            raise FlagError(
                f"{file}, step {number}: '{named}' is no processor step of LeRobot or of an installed plugin, and "
                "loading it could run any program; use another checkpoint, or install the plugin (a distribution "
                "named lerobot_policy_*) that has the step"
            )
        _require_known_code(step_class, entry.get("config") or {}, f"{file}, step {number} ('{named}')")
    return [file.parent / str(entry["state_file"]) for entry in steps if entry.get("state_file")]


def _step_class(entry: Mapping[str, Any]) -> type[ProcessorStep] | None:
    """The admitted class of a step; nothing is imported that is not of LeRobot or an installed plugin."""
    if "registry_name" in entry:  # as in LeRobot, it counts before a class
        known = entry["registry_name"] in ProcessorStepRegistry.list()
        return ProcessorStepRegistry.get(entry["registry_name"]) if known else None
    module, _, name = str(entry.get("class")).rpartition(".")
    if module.partition(".")[0] not in admitted_packages():
        return None
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError:
        return None
    return found if isinstance(found, type) and issubclass(found, ProcessorStep) else None


def admitted_packages() -> set[str]:
    """Packages whose processor steps may be built: LeRobot's, ours, and installed plugins'."""
    return {*OWN_PACKAGES, *plugins()}


def plugins() -> Iterator[str]:
    """Names of the installed distributions that LeRobot imports as plugins."""
    for distribution in importlib.metadata.distributions():
        name = distribution.metadata.get("Name") or ""
        if name.startswith(PLUGIN_PREFIXES):
            yield name


def require_known_policy(config: PreTrainedConfig, path: str | Path) -> None:
    """Refuse a policy that would run code of a Hub repository which its config.json chooses.

    Raises:
        FlagError: naming the setting.
    """
    _require_known_code(type(config), vars(config), f"{path}/config.json")


def _require_known_code(kind: type, settings: Mapping[str, Any], place: str) -> None:
    for name in CODE_FROM_HUB.get(kind.__name__, ()):
        value = settings.get(name)
        require(
            value in (None, getattr(kind, name, None), *KNOWN_CODE),
            f"{place}: {name}='{value}' names a Hub repository whose code would be run; use another checkpoint, or "
            f"one of {list(KNOWN_CODE)} there",
        )


# ---- files ----


def _processor_file(path: str | Path, name: str, revision: str | None) -> Path:
    """A processor file on this machine."""
    if Path(path).is_dir():
        file = Path(path) / name
        if file.is_file():
            return file
        missing = f"{file} is missing"
    else:
        try:
            return Path(hf_hub_download(str(path), name, revision=revision))
        except Exception as error:
            missing = f"{name} of the Hub repository {path} cannot be had ({error})"
    raise FlagError(
        f"{missing}; if the checkpoint is from before LeRobot 0.4, which had no such files, run: python -m "
        f"lerobot.processor.migrate_policy_normalization --pretrained-path {path}"
    )


def require_safetensors(folder: Path) -> None:
    """Refuse a checkpoint folder whose weights are missing, damaged or pickled.

    Raises:
        ValueError: naming the file and what to do.
    """
    weights = folder / SAFETENSORS_SINGLE_FILE
    if weights.is_file():
        stored_shapes(weights, RESTORE)
        return
    pickled = sorted(path.name for pattern in PICKLED for path in folder.glob(pattern))
    reason = f"; {pickled} could run any program when loaded and are never read" if pickled else ""
    raise ValueError(f"{weights} is missing{reason}; {RESTORE}")
