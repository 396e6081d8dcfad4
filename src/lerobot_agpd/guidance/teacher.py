"""A pretrained LeRobot policy as a teacher: its own processors, batched chunks, guided where it denoises.

How a policy is sampled is the business of an adapter, one small class per family of policies:

    policy                      adapter                          guided by
    diffusion and subclasses    adapters/diffusion.py            the scheduler's step
    multi_task_dit              adapters/flow.py                 the scheduler's step, or the velocity
    pi0, pi05, smolvla          adapters/rtc.py                  the velocity, through LeRobot's RTC hook
    any other                   adapters/chunk.py                - (it can act alone or beside the student)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from typing import Any, ClassVar, get_args

import torch
from lerobot.configs import PolicyFeature
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import (
    NormalizerProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    RelativeActionsProcessorStep,
    TokenizerProcessorStep,
)
from lerobot.utils.constants import ACTION
from lerobot.utils.random_utils import seeded_context
from torch import Tensor

from lerobot_agpd.config import GuidancePoint
from lerobot_agpd.flag_checks import FlagError, require
from lerobot_agpd.guidance.action_normalizer import ActionNormalizer
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.guidance.pull import Sampler

Features = Mapping[str, PolicyFeature]

History = Mapping[str, Any]
"""Raw observations per feature, (B, T, ...), and under "task" B instructions where the teacher reads them."""

TASK = "task"


class Teacher(ABC):
    """Samples chunks from a policy; keeps no state between calls.

    It is deliberately not an nn.Module: as an attribute of a student it must not enter the student's
    state_dict, DDP or `.to()`. Building one neither copies nor changes the policy, so a policy that is still
    in training can be its own teacher.

    Attributes:
        can_be_guided: whether `sample` takes a guide.
    """

    can_be_guided: ClassVar[bool]

    def __init__(
        self,
        policy: PreTrainedPolicy,
        preprocessor: PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
        postprocessor: PolicyProcessorPipeline[PolicyAction, PolicyAction],
    ):
        """Wrap a policy and its processors.

        Raises:
            ValueError: if its action space depends on the observation or is not known.
        """
        self.policy: Any = policy
        self._preprocessor = preprocessor
        self._postprocessor = postprocessor
        normalizers = [step for step in preprocessor.steps if isinstance(step, NormalizerProcessorStep)]
        if not normalizers:
            raise ValueError(
                f"the preprocessor of the {self.type} teacher has no normalizer, so its action space is unknown; "
                f"its steps are {[type(step).__name__ for step in preprocessor.steps]}"
            )
        self._action_normalizer = ActionNormalizer(normalizers[0], self.action_feature.shape[0])
        if any(
            isinstance(step, RelativeActionsProcessorStep) and step.enabled for step in preprocessor.steps
        ):
            raise ValueError(
                f"the {self.type} teacher predicts actions relative to the current state "
                "(use_relative_actions=true), which cannot be compared with a student's; use a teacher trained "
                "with use_relative_actions=false"
            )

    # ---- what it is ----

    @property
    def type(self) -> str:
        """Its policy type, quoted, for messages."""
        return f"'{self.policy.config.type}'"

    @property
    def n_obs_steps(self) -> int:
        """Length of the observation history it needs."""
        return self.policy.config.n_obs_steps

    @property
    def start(self) -> int:
        """Index of the current step in its internal chunk."""
        return 0

    @property
    @abstractmethod
    def n_chunk_steps(self) -> int:
        """Steps of a chunk from the current one on."""

    @property
    def n_action_steps(self) -> int:
        """Steps it executes per prediction by itself."""
        return self.policy.config.n_action_steps

    @property
    def n_denoising_steps(self) -> int | None:
        """Denoising steps of a chunk as it samples now; None: it predicts in one pass."""
        return None

    @property
    def input_features(self) -> Features:
        """Observations it needs."""
        return self.policy.config.input_features

    @property
    def action_feature(self) -> PolicyFeature:
        """Its action space."""
        return self.policy.config.output_features[ACTION]

    @property
    def resizes_images(self) -> bool:
        """Whether it accepts images of any size."""
        return False

    @property
    def needs_task(self) -> bool:
        """Whether it reads an instruction."""
        return any(isinstance(step, TokenizerProcessorStep) for step in self._preprocessor.steps)

    @property
    def guidance_points(self) -> tuple[GuidancePoint, ...]:
        """Where J can be differentiated (`--policy.guidance.at`)."""
        return get_args(GuidancePoint) if self.can_be_guided else ()

    @property
    def sampler(self) -> Sampler | None:
        """Its denoising steps as numbers, from which a pull follows; None if they are of no known form."""
        return None

    # ---- action spaces ----

    def normalize(self, actions_raw: Tensor) -> Tensor:
        """Raw actions (..., A) in the teacher's normalized space."""
        return self._action_normalizer.normalize(actions_raw)

    def unnormalize(self, actions: Tensor) -> Tensor:
        """Actions (..., A) of the teacher's normalized space in the environment's units."""
        return self._postprocessor(actions).to(actions.device)

    # ---- sampling ----

    @torch.no_grad()
    def sample(
        self, history: History, guide: Guide | None = None, generator: torch.Generator | None = None
    ) -> Tensor:
        """Predict chunks.

        Args:
            history: raw observations per feature, (B, T, ...), of which the last n_obs_steps are used, images as
                floats in [0, 1]; under "task" B strings, if the teacher reads instructions.
            guide: pulls rows toward another chunk; rows with scale 0 equal unguided ones bit for bit.
            generator: source of the sampling noise; default: torch's global one.

        Returns:
            (B, n_chunk_steps, A) raw actions from the current step on.

        Raises:
            KeyError: if the history lacks a feature or the instruction.
            ValueError: if the history is too short.
            FlagError: if the teacher cannot be guided this way.
            FloatingPointError: if it predicts a chunk, unguided, that is not finite.
        """
        if guide is not None:
            self.require_guidance(guide.at)
        with _eval_mode(self.policy):
            chunk = self._sample_chunk(self._prepare(history), guide, generator)  # (B, H, A)
        actions = self.unnormalize(chunk[:, self.start : self.start + self.n_chunk_steps])
        if guide is None and not bool(torch.isfinite(actions).all()):  # guided: the student may be the cause
            raise FloatingPointError(
                f"the {self.type} teacher (--policy.teacher.path) predicts actions that are not finite; are the "
                "observations in the units that it was trained with?"
            )
        return actions

    @abstractmethod
    def _sample_chunk(
        self, batch: dict[str, Any], guide: Guide | None, generator: torch.Generator | None
    ) -> Tensor:
        """The whole internal chunk, (B, H, A), in the teacher's normalized space; called inside no_grad.

        Args:
            batch: preprocessed features (B, n_obs_steps, ...), and whatever else the preprocessor made of the
                last step (B, ...), such as language tokens.
            guide: None, or one that this teacher takes (`require_guidance`).
            generator: of the noise; `seeded_by` serves code that takes none.
        """

    def require_guidance(self, at: GuidancePoint) -> None:
        """Refuse guidance that this teacher cannot follow.

        Raises:
            FlagError: if it cannot be guided, or not at this point.
        """
        require(
            self.can_be_guided,
            f"--policy.collect.strategy: a {self.type} teacher predicts its chunk in one pass, so there is no denoising "
            "to guide; let it act alone (--policy.collect.strategy=teacher) or beside the student (mixing), or take a "
            "diffusion or flow-matching teacher",
        )
        require(
            at in self.guidance_points,
            f"--policy.guidance.at={at} has no meaning for this {self.type} teacher: a flow has no posterior mean; use "
            f"--policy.guidance.at={next(iter(self.guidance_points), '')}",
        )

    def set_sampler(self, num_inference_steps: int | None, noise_scheduler: str | None) -> None:
        """Sample otherwise than the checkpoint says; None keeps its way.

        Raises:
            FlagError: if the teacher has no such setting, or not with this value.
        """
        if num_inference_steps is not None:
            raise self.no_such_setting(
                "num_inference_steps", num_inference_steps, "does not denoise in steps"
            )
        if noise_scheduler is not None:
            raise self.no_such_setting("noise_scheduler", noise_scheduler, "has no noise scheduler")

    def no_such_setting(self, name: str, value: object, why: str) -> FlagError:
        """The error for a `--policy.teacher.*` flag that means nothing to this teacher."""
        return FlagError(
            f"--policy.teacher.{name}={value} has no meaning for this {self.type} teacher, which {why}; leave "
            "the flag out"
        )

    # ---- observations ----

    def _prepare(self, history: History) -> dict[str, Any]:
        """Run the preprocessor on each of the last n_obs_steps observations."""
        keys, n_obs = list(self.input_features), self.n_obs_steps
        missing = [key for key in keys if key not in history]
        if missing:
            raise KeyError(f"the teacher needs {missing}; it was given {sorted(history)}")
        if self.needs_task and TASK not in history:
            raise KeyError(
                f"the {self.type} teacher follows instructions: the history must hold 'task', one string per row; "
                f"it was given {sorted(history)}"
            )
        batch_size, length = history[keys[0]].shape[:2]
        if length < n_obs:
            raise ValueError(f"the teacher needs {n_obs} observations in a row, it was given {length}")
        flat: dict[str, Any] = {key: history[key][:, -n_obs:].flatten(0, 1) for key in keys}
        if TASK in history:
            flat[TASK] = [task for task in history[TASK] for _ in range(n_obs)]
        batch = {}
        for key, value in self._preprocessor(flat).items():
            if isinstance(value, Tensor) and value.shape[:1] == (batch_size * n_obs,):
                rows = value.unflatten(0, (batch_size, n_obs))
                batch[key] = rows if key in keys else rows[:, -1]
        return batch

    def _now(self, batch: dict[str, Any]) -> dict[str, Any]:
        """The prepared batch at the current step alone, (B, ...), for policies that take no history."""
        return {key: value[:, -1] if key in self.input_features else value for key, value in batch.items()}


@contextmanager
def _eval_mode(policy: PreTrainedPolicy) -> Iterator[None]:
    """Evaluate the policy, and leave it in the mode in which it was."""
    was_training = policy.training
    if was_training:
        policy.eval()
    try:
        yield
    finally:
        if was_training:
            policy.train()


def seeded_by(generator: torch.Generator | None) -> Any:
    """Context in which global random numbers follow from the generator, and are as before afterwards."""
    if generator is None:
        return nullcontext()
    seed = torch.randint(2**32, (), generator=generator, device=generator.device)
    return seeded_context(int(seed))
