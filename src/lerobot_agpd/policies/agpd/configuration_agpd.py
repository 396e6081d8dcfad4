"""Configuration of the ACT student trained by AGPD."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import DiffuserSchedulerConfig
from lerobot.policies.act.configuration_act import ACTConfig

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.flag_checks import require, require_at_least, require_scheduler

EncoderName = Literal["resnet", "resnet_group_norm", "small"]


@PreTrainedConfig.register_subclass("agpd")
@dataclass
class AGPDConfig(ACTConfig, StudentConfig):
    """LeRobot's ACT with the groups of the distillation; all of ACT's fields keep their meaning and defaults."""

    # As LeRobot's ACT, and observation.environment_state too, which that one takes as it is.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.MEAN_STD,
            "STATE": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )
    # Features of the demonstrations that the student sees, e.g. '["observation.state","observation.image"]'; default: all.
    # The teacher sees what it was trained on, whatever the student sees.
    inputs: list[str] | None = None
    # Image encoder. resnet: LeRobot's vision_backbone, whose batch norm is the pretrained weights' and frozen;
    # resnet_group_norm: the same without pretrained weights; small: four convolutions, for a CPU. The last two learn from
    # scratch, so they take optimizer_lr in the place of optimizer_lr_backbone.
    encoder: EncoderName = "resnet"
    # encoder=small: largest random shift of training images, pixels; 0: none.
    encoder_shift: int = 2
    # Learning rate schedule, e.g. cosine; default: constant, as LeRobot trains ACT.
    scheduler_name: str | None = None
    # Steps over which a scheduled learning rate rises.
    scheduler_warmup_steps: int = 500

    def __post_init__(self) -> None:
        super().__post_init__()
        require_scheduler(self.scheduler_name)
        require_at_least(self, 0, "scheduler_warmup_steps", "encoder_shift")
        if self.encoder != "resnet":
            self.pretrained_backbone_weights = None
            self.optimizer_lr_backbone = self.optimizer_lr
        n_steps = self.collect.n_action_steps
        require(
            n_steps is None or n_steps <= self.chunk_size,
            f"--policy.collect.n_action_steps={n_steps} exceeds the student's chunk "
            f"(--policy.chunk_size={self.chunk_size})",
        )

    def get_scheduler_preset(self) -> DiffuserSchedulerConfig | None:  # type: ignore[override]
        """The named schedule over the run's steps, None for a constant learning rate."""
        if self.scheduler_name is None:
            return None
        return DiffuserSchedulerConfig(name=self.scheduler_name, num_warmup_steps=self.scheduler_warmup_steps)

    @property
    def action_delta_indices(self) -> None:  # type: ignore[override]
        """None: the loader delivers single frames, chunks are cut from memory."""
        return None

    @property
    def chunk_delta_indices(self) -> list[int]:
        """Steps of a chunk relative to the current one."""
        return list(range(self.chunk_size))

    @property
    def history_length(self) -> None:
        """None: ACT looks at the current observation alone, without a time dimension."""
        return None
