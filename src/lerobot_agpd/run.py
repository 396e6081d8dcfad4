"""What a policy must know of the run that trains it: `RunInfo`, resolved once, when the policy is built."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import EnvConfig
from lerobot.transforms import ImageTransforms
from torch import Tensor


@dataclass(frozen=True)
class RunInfo:
    """Facts of a training run.

    Attributes:
        output_dir: folder that the run writes; None outside of a run.
        env: evaluation environment, or None.
        steps: training steps, counted as `--steps` counts them; None if unknown.
        steps_per_update: of those, steps per optimizer step (gradient accumulation).
        resume: whether the run continues a checkpoint.
        image_transforms: what the loader does to training images (..., C, H, W), or None.
        lerobot_ema: whether LeRobot keeps averaged weights of its own (`--ema.enable`).
        sharded: whether parameters are spread over processes (`--parallelism.*`, FSDP).
        datasets: what the run's loaders read.
    """

    output_dir: Path | None = None
    env: EnvConfig | None = None
    steps: int | None = None
    steps_per_update: int = 1
    resume: bool = False
    image_transforms: Callable[[Tensor], Tensor] | None = None
    lerobot_ema: bool = False
    sharded: bool = False
    datasets: tuple[LeRobotDataset, ...] = field(default=(), compare=False, repr=False)

    @classmethod
    def from_train_config(cls, config: TrainPipelineConfig) -> RunInfo:
        """The facts that a (validated) configuration of `lerobot-train` states.

        Fields that only later releases of LeRobot have count as unset where they are missing.
        """
        transforms = config.dataset.image_transforms
        accelerator, ema = (getattr(config, name, None) for name in ("accelerator", "ema"))
        accumulation = getattr(accelerator, "gradient_accumulation", None)
        parallelism = getattr(config, "parallelism", None)
        return cls(
            output_dir=config.output_dir,
            env=config.env,
            steps=config.steps,
            steps_per_update=getattr(accumulation, "steps", 1),
            resume=config.resume,
            image_transforms=ImageTransforms(transforms) if transforms.enable else None,
            lerobot_ema=getattr(ema, "enable", False),
            sharded=getattr(parallelism, "dp_shard", 1) not in (1, None)
            or os.environ.get("ACCELERATE_USE_FSDP") == "true",  # how LeRobot 0.6.1 is told
        )

    @classmethod
    def of(cls, policy_config: PreTrainedConfig) -> RunInfo | None:
        """The run that is building a policy with this configuration; None outside of training.

        LeRobot tells a policy neither its output folder nor its environment, and re-reading the command line would
        miss `train(config)` called from Python. Both ways hold the same object: the TrainPipelineConfig whose `policy`
        is this very configuration, in a function that is building the policy right now. The datasets that its loaders
        will read are beside it.
        """
        for values in _locals_of_callers():
            for config in values:
                if isinstance(config, TrainPipelineConfig) and config.policy is policy_config:
                    datasets = tuple(value for value in values if isinstance(value, LeRobotDataset))
                    return replace(cls.from_train_config(config), datasets=datasets)
        return None


def _locals_of_callers() -> Iterator[list[object]]:
    frame = inspect.currentframe()
    while frame is not None:
        yield list(frame.f_locals.values())
        frame = frame.f_back
