"""Configuration of the ACT student trained by AGPD."""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path

import draccus
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import PreTrainedConfig
from lerobot.optim import DiffuserSchedulerConfig
from lerobot.policies.act.configuration_act import ACTConfig

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.distill.config import AdversaryConfig
from lerobot_agpd.guidance.config import GuidanceConfig, RepresentationConfig, TeacherConfig
from lerobot_agpd.replay.config import ReplayConfig


@PreTrainedConfig.register_subclass("agpd")
@dataclass
class AGPDConfig(ACTConfig):
    """LeRobot's ACT with the groups of the distillation; all of ACT's fields keep their meaning and defaults."""

    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    collect: CollectConfig = field(default_factory=CollectConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    adversary: AdversaryConfig = field(default_factory=AdversaryConfig)
    representation: RepresentationConfig = field(default_factory=RepresentationConfig)
    scheduler_name: str | None = (
        None  # learning rate schedule, e.g. cosine; default: constant, as LeRobot trains ACT
    )
    scheduler_warmup_steps: int = 500  # steps over which a scheduled learning rate rises

    def __post_init__(self) -> None:
        super().__post_init__()
        n_steps = self.collect.n_action_steps
        if n_steps is not None and n_steps > self.chunk_size:
            raise ValueError(
                f"--policy.collect.n_action_steps={n_steps} exceeds the student's chunk "
                f"(--policy.chunk_size={self.chunk_size})"
            )

    def get_scheduler_preset(self) -> DiffuserSchedulerConfig | None:
        """The named schedule over the run's steps, None for a constant learning rate."""
        if self.scheduler_name is None:
            return None
        return DiffuserSchedulerConfig(name=self.scheduler_name, num_warmup_steps=self.scheduler_warmup_steps)

    @property
    def action_delta_indices(self) -> None:
        """None: the loader delivers single frames, chunks are cut from memory."""
        return None

    def _save_pretrained(self, save_directory: Path) -> None:
        # The environment stays out of config.json: a checkpoint must load where its type is not registered.
        # The run's train_config.json has it.
        config = deepcopy(self)
        config.collect.env = None
        with open(save_directory / CONFIG_NAME, "w") as file:
            json.dump(draccus.encode(config, PreTrainedConfig), file, indent=4)
