"""The groups of flags that every student of AGPD has: `--policy.<group>.<field>` of `lerobot-train`."""

from __future__ import annotations

import json
from abc import abstractmethod
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import draccus
from huggingface_hub.constants import CONFIG_NAME
from huggingface_hub.utils import HFValidationError, validate_repo_id
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig

from lerobot_agpd.flag_checks import FlagError, require, require_finite

EVALUATION_SEEDS = (100_000, 1_000_000)
"""Environment seeds left to final evaluations; LeRobot's own evaluation during training counts up from --seed."""

DEFAULT_PULL = 0.6
"""Pull of the first round (docs/method.md says why)."""

COLLECTION_SEEDS = (1_000_000, 2**31 - 1)
"""Environment seeds that collection draws from."""


# Named, not spelled out at the fields: the flag parser finds a field's comment only if its annotation is plain words.
NoiseScheduler = Literal["DDPM", "DDIM"]
GuidancePoint = Literal["x0", "mu"]
StrengthUnit = Literal["pull", "scale"]
RepresentationType = Literal["action", "state", "visual"]
StrategyName = Literal["guided", "nearest", "teacher", "mixing", "rollin"]
MixingForm = Literal["interpolate", "switch"]
Relabel = Literal["none", "demonstrations", "all"]


@dataclass
class TeacherConfig:
    """The frozen policy to learn from (docs/teachers.md)."""

    # Checkpoint folder or Hub repository of a LeRobot policy; empty: no teacher.
    path: str = ""
    # Denoising steps while collecting; default: the checkpoint's.
    num_inference_steps: int | None = None
    # Noise scheduler while collecting (diffusion only); default: the checkpoint's.
    noise_scheduler: NoiseScheduler | None = None

    def __post_init__(self) -> None:
        require(
            self.num_inference_steps is None or self.num_inference_steps >= 1,
            f"--policy.teacher.num_inference_steps must be at least 1, got {self.num_inference_steps}",
        )


@dataclass
class GuidanceConfig:
    """How strongly, and where, the teacher's denoising is pulled toward the student (Eq. 20)."""

    # Pull of the first round: how far a chunk goes toward the student, from 0 (guidance off) to 1. The guidance scale is
    # computed from it for the teacher's own sampler (guidance/pull.py). Default: 0.6, or as much of it as the teacher's
    # denoising steps can follow.
    pull: float | None = None
    # Instead of a pull: guidance scale k of the first round (Eq. 20), which pulls differently with every sampler; positive
    # is toward the student.
    scale: float | None = None
    # Where J is differentiated: predicted clean chunk, or posterior mean as printed (flows have none).
    at: GuidancePoint = "x0"
    # Adapt the pull (or scale) from round to round to keep the teacher's success rate.
    adaptive: bool = True
    # The adapted pull never exceeds this.
    max_pull: float = 1.0
    # The adapted scale never exceeds this (where guidance.scale is given).
    max_scale: float = 2.0

    def __post_init__(self) -> None:
        require_finite(self, "guidance")
        require(
            self.pull is None or self.scale is None,
            f"--policy.guidance.pull={self.pull} and --policy.guidance.scale={self.scale} exclude each other: both say how "
            "strongly guidance acts; give one of them",
        )
        require(
            self.pull is None or 0 <= self.pull <= 1,
            f"--policy.guidance.pull must be in [0, 1], got {self.pull}",
        )
        require(
            self.scale is None or self.scale >= 0,
            f"--policy.guidance.scale must not be negative, got {self.scale}",
        )
        require(0 < self.max_pull <= 1, f"--policy.guidance.max_pull must be in (0, 1], got {self.max_pull}")
        require(self.max_scale > 0, f"--policy.guidance.max_scale must be positive, got {self.max_scale}")

    @property
    def unit(self) -> StrengthUnit:
        """What the strength of a guided episode is: a pull, or a guidance scale."""
        return "pull" if self.scale is None else "scale"

    @property
    def is_default(self) -> bool:
        """Whether no strength was given."""
        return self.pull is None and self.scale is None

    @property
    def first_strength(self) -> float:
        """Strength of the first round, in `unit`; the default may be more than a teacher's sampler can follow."""
        if self.scale is not None:
            return self.scale
        return DEFAULT_PULL if self.pull is None else self.pull

    @property
    def max_strength(self) -> float:
        """Upper limit of an adapted strength, in `unit`."""
        return self.max_pull if self.scale is None else self.max_scale


@dataclass
class RepresentationConfig:
    """In which space the discrepancy J compares two chunks (appendix A.4)."""

    # action: the chunks themselves; state, visual: the future low-dimensional observations, or features of camera images,
    # that a learned model predicts for them.
    type: RepresentationType = "action"
    # type=visual: whose features. A frozen DINOv2 of transformers, Hub repository or folder, or student: the student's own.
    encoder: str = "facebook/dinov2-small"


@dataclass
class MixingConfig:
    """strategy=mixing: how teacher and student share the actions (DAgger, arXiv:1011.0686; Eq. 6-7)."""

    # interpolate: between both chunks (Eq. 6); switch: one of them at random (Eq. 7).
    form: MixingForm = "interpolate"
    # Mixing weight lambda, the student's part of the actions; DAgger's beta is 1 - lambda.
    weight: float = 0.3
    # Record the teacher's action instead of the executed one, as DAgger does.
    record_teacher: bool = False

    def __post_init__(self) -> None:
        require_finite(self, "collect.mixing")
        require(0 <= self.weight <= 1, f"--policy.collect.mixing.weight must be in [0, 1], got {self.weight}")


@dataclass
class CollectConfig:
    """When, where and how new episodes are collected (stage 1)."""

    # Environment to collect in; default: the run's --env.*.
    env: EnvConfig | None = None
    # guided: AGPD; nearest: of several samples of the teacher the one nearest to the student's chunk; teacher: the
    # teacher alone (PD); mixing: DAgger; rollin: the student begins, the teacher finishes.
    strategy: StrategyName = "guided"
    # strategy=nearest: samples of the teacher per decision, of which one is executed; at their cost.
    nearest_samples: int = 8
    # Settings of strategy=mixing.
    mixing: MixingConfig = field(default_factory=MixingConfig)
    # Training steps on the demonstrations before the first round.
    warmup: int = 1000
    # Training steps between rounds; 0: never collect.
    every: int = 1000
    # Number of rounds; default: until training ends.
    rounds: int | None = None
    # Episodes generated per round, over all processes.
    episodes: int = 50
    # Environments stepped side by side in every process.
    n_envs: int = 16
    # Step them in worker processes: worth it for slow rendering and many cores.
    use_async_envs: bool = False
    # Seconds that a reset or step may take. Then an environment in a worker process is given up, another warned of.
    step_timeout: float = 60.0
    # Steps after which an episode that its environment has not ended is cut off; default: the environment's own limit.
    max_episode_steps: int | None = None
    # Fraction of a round in which the teacher acts alone, to know its own success rate.
    teacher_only_fraction: float = 0.2
    # Largest fraction of a round that starts again where the earlier rounds' episodes have failed.
    retry_fraction: float = 0.0
    # Keep episodes whose largest reward reaches this; default: the environment's is_success.
    min_reward: float | None = None
    # Keep episodes that fail too, for imitation of the teacher's own chunks (replay.relabel=all).
    keep_failures: bool = False
    # Steps executed per decision; default: the smaller of the teacher's and the student's.
    n_action_steps: int | None = None
    # Measure in every round what the strategy does to actions and states; it never changes the episodes.
    diagnostics: bool = True
    # Upload the merged episodes as a dataset when training ends.
    push_to_hub: bool = False
    # Hub repository of the merged episodes; required to upload.
    repo_id: str | None = None

    def __post_init__(self) -> None:
        require_finite(self, "collect")
        require(self.every >= 0, f"--policy.collect.every must not be negative, got {self.every}")
        require(
            self.step_timeout > 0, f"--policy.collect.step_timeout must be positive, got {self.step_timeout}"
        )
        require(
            self.max_episode_steps is None or self.max_episode_steps >= 1,
            f"--policy.collect.max_episode_steps must be at least 1, got {self.max_episode_steps}",
        )
        for name in ("warmup", "episodes", "n_envs"):
            value = getattr(self, name)
            require(value >= 1, f"--policy.collect.{name} must be at least 1, got {value}")
        require(
            self.rounds is None or self.rounds >= 0,
            f"--policy.collect.rounds must not be negative, got {self.rounds}",
        )
        for name in ("teacher_only_fraction", "retry_fraction"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"--policy.collect.{name} must be in [0, 1], got {value}")
        require(
            self.nearest_samples >= 2,
            f"--policy.collect.nearest_samples must be at least 2, got {self.nearest_samples}",
        )
        require(
            self.n_action_steps is None or self.n_action_steps >= 1,
            f"--policy.collect.n_action_steps must be at least 1, got {self.n_action_steps}",
        )
        require(
            not self.push_to_hub or bool(self.repo_id),
            "--policy.collect.push_to_hub=true needs --policy.collect.repo_id",
        )
        self._require_repo_id()

    def _require_repo_id(self) -> None:
        if self.repo_id is not None:
            try:
                validate_repo_id(self.repo_id)
            except HFValidationError as error:
                raise FlagError(f"--policy.collect.repo_id='{self.repo_id}': {error}") from error

    @property
    def enabled(self) -> bool:
        """Whether any round will be collected."""
        return self.every > 0 and self.rounds != 0

    @property
    def guides(self) -> bool:
        """Whether the teacher is guided, and the strength adapted from round to round."""
        return self.strategy in ("guided", "rollin")


@dataclass
class ReplayConfig:
    """The replay T: demonstrations plus every kept episode."""

    # Folder of the collected episodes; default: <output_dir>/agpd.
    root: str | None = None
    # Fraction of every batch that collected frames fill; default: uniform over T.
    collected_fraction: float | None = None
    # Frames whose recorded chunks are exchanged for the teacher's own.
    relabel: Relabel = "none"
    # Another background in every training image, drawn anew each time: noise, stripes or a folder of pictures. Needs masks,
    # recorded and collected with --env.masks=true. Default: images as they are.
    backgrounds: str | None = None

    def __post_init__(self) -> None:
        require_finite(self, "replay")
        require(
            self.collected_fraction is None or 0 <= self.collected_fraction < 1,
            f"--policy.replay.collected_fraction must be in [0, 1), got {self.collected_fraction}",
        )


@dataclass
class AdversaryConfig:
    """The discriminator D and the student's adversarial loss (Eq. 21-22)."""

    # Weight s of the adversarial loss in the student's objective (Eq. 22); 0: no adversary.
    weight: float = 0.05
    # Training steps per adversarial step; more is cheaper, since each takes a second forward pass.
    every: int = 1
    # Training steps before the adversary acts, so that D does not meet an untrained student.
    start: int = 500
    # Learning rate of D.
    lr: float = 1e-4

    def __post_init__(self) -> None:
        require_finite(self, "adversary")
        require(self.weight >= 0, f"--policy.adversary.weight must not be negative, got {self.weight}")
        require(self.start >= 0, f"--policy.adversary.start must not be negative, got {self.start}")
        require(self.every >= 1, f"--policy.adversary.every must be at least 1, got {self.every}")
        require(self.lr > 0, f"--policy.adversary.lr must be positive, got {self.lr}")


@dataclass
class StudentConfig(PreTrainedConfig):
    """Configuration of a student: the groups of the method beside those of a LeRobot policy.

    A concrete class names it behind the policy's own configuration, whose defaults then count. It declares `inputs` again:
    the flag parser reads the comments of a class itself alone.
    """

    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    representation: RepresentationConfig = field(default_factory=RepresentationConfig)
    collect: CollectConfig = field(default_factory=CollectConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    adversary: AdversaryConfig = field(default_factory=AdversaryConfig)
    # Features of the demonstrations that the student sees, e.g. '["observation.state","observation.image"]'; default: all.
    # The teacher sees what it was trained on, whatever the student sees.
    inputs: list[str] | None = None

    def select_inputs(self) -> None:
        """Leave of `input_features`, which LeRobot fills with all of a dataset's, those that `inputs` names.

        Raises:
            FlagError: if one of them does not exist.
        """
        if self.inputs is None:
            return
        available = self.input_features or {}
        missing = sorted(set(self.inputs) - set(available))
        require(
            not missing,
            f"--policy.inputs={self.inputs}: {missing} is not among the features of the demonstrations "
            f"(--dataset.*), which hold {sorted(available)}",
        )
        self.input_features = {key: available[key] for key in available if key in self.inputs}

    @property
    @abstractmethod
    def chunk_delta_indices(self) -> list[int]:
        """Steps of a chunk relative to the current one."""

    @property
    @abstractmethod
    def history_length(self) -> int | None:
        """Observations in a history (B, T, ...); None: the current one alone, without a time dimension."""

    @property
    def n_execute(self) -> int:
        """Steps that the policy executes per prediction by itself."""
        return int(self.n_action_steps)  # type: ignore[attr-defined]  # every policy that predicts chunks has it

    @property
    def present_step(self) -> int:
        """Index of the current step in a chunk; before it lies the past that diffusion policies predict too."""
        return self.chunk_delta_indices.index(0)

    @property
    def future_steps(self) -> int:
        """Steps S of a chunk from the current one on."""
        return len(self.chunk_delta_indices) - self.present_step

    @property
    def predicted_steps(self) -> int:
        """Those of them that `predict_action_chunk` returns."""
        return self.future_steps

    @property
    def uses_teacher(self) -> bool:
        """Whether any part of the method uses a teacher."""
        return self.collect.enabled or self.needs_teacher_chunks

    @property
    def needs_guidance(self) -> bool:
        """Whether the teacher must be one that can be guided; roll-in with a strength of 0 leaves it alone."""
        strategy = self.collect.strategy
        return strategy == "guided" or (strategy == "rollin" and self.guidance.first_strength > 0)

    @property
    def needs_teacher_chunks(self) -> bool:
        """Whether the adversary or relabeling uses the teacher's chunks at recorded observations."""
        return self.adversary.weight > 0 or self.replay.relabel != "none"

    @property
    def observed_vectors(self) -> list[str]:
        """Low-dimensional input features."""
        return [key for key in self.input_features or {} if key not in self.image_features]

    def _save_pretrained(self, save_directory: Path) -> None:
        # The environment stays out of config.json: a checkpoint must load where its type is not registered.
        # The run's train_config.json has it.
        config = deepcopy(self)
        config.collect.env = None
        with open(save_directory / CONFIG_NAME, "w") as file:
            json.dump(draccus.encode(config, PreTrainedConfig), file, indent=4)
