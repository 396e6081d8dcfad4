"""What the command line (or config file) says of the running `lerobot-train`, which a policy is never told."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import draccus
import torch
import yaml
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.envs import EnvConfig
from lerobot.transforms import ImageTransforms, ImageTransformsConfig
from torch import Tensor


@dataclass(frozen=True)
class RunInfo:
    """Facts of a training run.

    Attributes:
        output_dir: where the run writes, or None if nobody named a folder.
        env: the evaluation environment, or None.
        steps: number of training steps; None if a run that was declared did not say.
        resume: whether the run continues a checkpoint.
        image_transforms: what the loader does to training images (..., C, H, W), or None.
        lerobot_ema: whether LeRobot averages the weights itself (`--ema.enable`).
        sharded: whether the processes share the parameters out among them (FSDP).
    """

    output_dir: Path | None = None
    env: EnvConfig | None = None
    steps: int | None = None
    resume: bool = False
    image_transforms: Callable[[Tensor], Tensor] | None = None
    lerobot_ema: bool = False
    sharded: bool = False

    @classmethod
    def of(cls, config: PreTrainedConfig) -> RunInfo:
        """Facts of the run that trains a policy of this configuration."""
        return this_run()


_declared: ContextVar[RunInfo | None] = ContextVar("declared_run", default=None)


@contextmanager
def declared_run(info: RunInfo) -> Iterator[None]:
    """State the facts of a run that is started from Python rather than from a command line."""
    token = _declared.set(info)
    try:
        yield
    finally:
        _declared.reset(token)


def this_run() -> RunInfo:
    """Facts of the run in this process: declared ones, else the command line over its config file."""
    declared = _declared.get()
    if declared is not None:
        return declared
    config = _config_file(parser.parse_arg("config_path"))
    output_dir = parser.parse_arg("output_dir") or config.get("output_dir")
    steps = parser.parse_arg("steps") or config.get("steps") or _default("steps")
    resume = parser.parse_arg("resume") or config.get("resume") or False
    return RunInfo(
        output_dir=Path(output_dir) if output_dir else None,
        env=_env(config.get("env")),
        steps=int(steps),
        resume=resume if isinstance(resume, bool) else draccus.decode(bool, yaml.safe_load(resume)),
        image_transforms=_image_transforms(config.get("dataset")),
        lerobot_ema=parser.parse_arg("ema.enable") == "true",
        sharded=os.environ.get("ACCELERATE_USE_FSDP", "false").lower() == "true",
    )


def _default(name: str) -> Any:
    """What lerobot-train takes where nobody says anything."""
    return next(field.default for field in fields(TrainPipelineConfig) if field.name == name)


def process_rank() -> int:
    """Rank of this process among those that accelerate or torchrun started."""
    return int(os.environ.get("RANK", "0"))


def world_size() -> int:
    """Number of processes of the run."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def _config_file(path: str | None) -> dict[str, Any]:
    """Contents of a `--config_path` file or checkpoint folder; empty for none and for a Hub repository."""
    if not path:
        return {}
    file = Path(path) / TRAIN_CONFIG_NAME if Path(path).is_dir() else Path(path)
    if not file.is_file():
        return {}
    text = file.read_text()
    return (json.loads(text) if file.suffix == ".json" else yaml.safe_load(text)) or {}


def _env(config: dict[str, Any] | None) -> EnvConfig | None:
    """The environment of `--env.*`, its flags over the config file's entry."""
    entry = dict(config or {})
    chosen = parser.parse_arg("env.type") or entry.get("type")
    if chosen is None:
        return None
    if chosen != entry.pop("type", None):
        entry = {}  # another type on the command line: the file's fields are not its fields
    return _group(EnvConfig.get_choice_class(chosen), entry, "env")


def _image_transforms(config: dict[str, Any] | None) -> ImageTransforms | None:
    """The transforms of `--dataset.image_transforms.*`, as LeRobot's `make_dataset` builds them."""
    entry = (config or {}).get("image_transforms") or {}
    transforms = _group(ImageTransformsConfig, entry, "dataset.image_transforms")
    return ImageTransforms(transforms) if transforms.enable else None


def _group(kind: type, entry: dict[str, Any], name: str) -> Any:
    """A group of flags: the config file's entry, and what the command line says of `--<name>.*` over it."""
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file, draccus.config_type("json"):
        json.dump(entry, file)
        file.flush()
        return draccus.parse(kind, config_path=file.name, args=parser.get_cli_overrides(name) or [])


def barrier() -> None:
    """Wait for all processes of the run."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.barrier()


def broadcast(value: Any) -> Any:
    """Rank 0's value, on every process."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return value
    values = [value]
    torch.distributed.broadcast_object_list(values, src=0)
    return values[0]
