"""Flags of the adversary, and the groups of flags that every distilled student has."""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path

import draccus
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import PreTrainedConfig

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.guidance.config import GuidanceConfig, RepresentationConfig, TeacherConfig, require
from lerobot_agpd.replay.config import ReplayConfig

FORMS = ("saturating", "non_saturating")


@dataclass
class AdversaryConfig:
    """The discriminator D and the student's adversarial loss (Eq. 21-22)."""

    weight: float = (
        0.05  # s of Eq. 22, the adversarial loss's share of the student's objective; 0: no adversary
    )
    form: str = (
        "saturating"  # saturating: the student minimises log D, as printed; non_saturating: -log(1 - D)
    )
    every: int = (
        1  # training steps per adversarial step; more is cheaper, since each takes a second forward pass
    )
    start: int = 500  # training steps before the adversary acts, so that D does not meet an untrained student
    width: int = 128  # width of D's two hidden layers
    lr: float = 1e-4  # learning rate of D
    label_smoothing: float = 0.1  # D's target for teacher chunks, instead of 0
    gradient_penalty: float = 1.0  # weight of the squared gradient norm of D's logit at teacher chunks (R1)
    spectral_norm: bool = False  # bound the Lipschitz constant of D's layers

    def __post_init__(self) -> None:
        require(self.weight >= 0, f"--policy.adversary.weight must not be negative, got {self.weight}")
        require(
            self.form in FORMS,
            f"--policy.adversary.form must be one of {list(FORMS)}, got '{self.form}'",
        )
        require(self.start >= 0, f"--policy.adversary.start must not be negative, got {self.start}")
        require(self.every >= 1, f"--policy.adversary.every must be at least 1, got {self.every}")
        require(self.width >= 1, f"--policy.adversary.width must be at least 1, got {self.width}")
        require(self.lr > 0, f"--policy.adversary.lr must be positive, got {self.lr}")
        require(
            0 <= self.label_smoothing < 0.5,
            f"--policy.adversary.label_smoothing must be in [0, 0.5), got {self.label_smoothing}",
        )
        require(
            self.gradient_penalty >= 0,
            f"--policy.adversary.gradient_penalty must not be negative, got {self.gradient_penalty}",
        )


@dataclass
class DistilledConfig:
    """Mixin for the configuration of a student: the groups of the distillation.

    A concrete class names it before the policy's own configuration, and says which steps a chunk covers
    (`chunk_offsets`) and how many observations it looks at (`observation_history`).
    """

    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    collect: CollectConfig = field(default_factory=CollectConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    adversary: AdversaryConfig = field(default_factory=AdversaryConfig)
    representation: RepresentationConfig = field(default_factory=RepresentationConfig)

    @property
    def present_step(self) -> int:
        """Index of the current step in a chunk; before it lies the past that diffusion policies predict too."""
        return self.chunk_offsets.index(0)  # type: ignore[attr-defined]

    @property
    def future_steps(self) -> int:
        """Steps S of a chunk from the current one on."""
        return len(self.chunk_offsets) - self.present_step  # type: ignore[attr-defined]

    @property
    def predicted_steps(self) -> int:
        """Those of them that `predict_action_chunk` returns."""
        return self.future_steps

    def _save_pretrained(self, save_directory: Path) -> None:
        # The environment stays out of config.json: a checkpoint must load where its type is not registered.
        # The run's train_config.json has it.
        config = deepcopy(self)
        config.collect.env = None
        with open(save_directory / CONFIG_NAME, "w") as file:
            json.dump(draccus.encode(config, PreTrainedConfig), file, indent=4)
