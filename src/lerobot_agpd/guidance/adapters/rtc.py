"""Flow-matching policies with LeRobot's real-time-chunking (RTC) hook as teachers: pi0, pi05, smolvla.

RTC pulls a chunk toward what is left of the previous one (arXiv:2506.07339); the same hook pulls it toward the
student. LeRobot's `euler_integrate` calls the policy's RTC processor for every velocity, with time running from
1 (noise) to 0 (data) and velocities pointing from data to noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lerobot.policies.rtc import RTCConfig
from torch import Tensor

from lerobot_agpd.config import GuidancePoint
from lerobot_agpd.flag_checks import require
from lerobot_agpd.guidance.flow import guided_velocity
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.guidance.pull import Sampler, flow_sampler
from lerobot_agpd.guidance.teacher import Features, Teacher

EMPTY_CAMERA = "empty_camera"
"""Part of LeRobot's name for cameras that the policy fills in by itself."""


class RTCTeacher(Teacher):
    """A policy whose `predict_action_chunk` takes `noise` and whose `model` calls an RTC processor for velocities.

    Actions are padded to max_action_dim inside; the padding stays unguided.
    """

    can_be_guided = True

    def __init__(self, *args: Any):
        """Refuse variants that the hook cannot guide."""
        super().__init__(*args)
        for flag, consequence in (
            ("adapt_to_pi_aloha", "converts actions outside the space in which chunks are compared"),
            ("compile_model", "samples in a compiled graph, which a guide cannot enter"),
        ):
            require(
                not getattr(self.policy.config, flag, False),
                f"the {self.type} teacher has {flag}=true, so it {consequence}; it must be false",
            )

    @property
    def n_chunk_steps(self) -> int:
        """Steps of a chunk from the current one on."""
        return self.policy.config.chunk_size

    @property
    def input_features(self) -> Features:
        """Observations it needs, without the cameras that it fills in by itself."""
        features = self.policy.config.input_features
        return {key: feature for key, feature in features.items() if EMPTY_CAMERA not in key}

    @property
    def n_denoising_steps(self) -> int:
        """Euler steps."""
        return getattr(self.policy.config, self._steps_field)

    @property
    def _steps_field(self) -> str:
        """Where the configuration holds the number of Euler steps."""
        return "num_steps" if hasattr(self.policy.config, "num_steps") else "num_inference_steps"

    @property
    def resizes_images(self) -> bool:
        """Whether it accepts images of any size."""
        return True

    @property
    def guidance_points(self) -> tuple[GuidancePoint, ...]:
        """Where J can be differentiated: a flow has no posterior mean."""
        return ("x0",)

    @property
    def sampler(self) -> Sampler:
        """The Euler steps of its flow."""
        return flow_sampler(self.n_denoising_steps)

    def set_sampler(self, num_inference_steps: int | None, noise_scheduler: str | None) -> None:
        """Exchange the number of Euler steps."""
        if noise_scheduler is not None:
            raise self.no_such_setting("noise_scheduler", noise_scheduler, "integrates a flow")
        if num_inference_steps is not None:
            setattr(self.policy.config, self._steps_field, num_inference_steps)

    def _sample_chunk(
        self, batch: dict[str, Tensor], guide: Guide | None, generator: torch.Generator | None
    ) -> Tensor:
        now = self._now(batch)
        noise = self._noise(len(next(iter(now.values()))), generator)
        with velocities_guided(self.policy, guide, self.action_feature.shape[0]):
            return self.policy.predict_action_chunk(now, noise=noise)

    def _noise(self, batch_size: int, generator: torch.Generator | None) -> Tensor:
        config = self.policy.config
        shape = (batch_size, config.chunk_size, config.max_action_dim)
        device = None if generator is None else generator.device
        return torch.randn(shape, generator=generator, device=device).to(config.device)


class VelocityGuide:
    """An RTC processor for LeRobot's `euler_integrate` that guides toward the student's chunk.

    Args:
        guide: J and scales.
        action_dim: dimensions of the padded actions that are guided, the first ones.
    """

    def __init__(self, guide: Guide, action_dim: int):
        self.guide = guide
        self.action_dim = action_dim

    def denoise_step(
        self,
        x_t: Tensor,
        prev_chunk_left_over: Tensor | None,
        inference_delay: int | None,
        time: float,
        original_denoise_step_partial: Callable[[Tensor], Tensor],
        execution_horizon: int | None = None,
    ) -> Tensor:
        """Predict the guided velocity from data to noise, (B, H, D); the real-time arguments are not used."""
        velocity_to_data = -original_denoise_step_partial(x_t)
        return -guided_velocity(self.guide, x_t, velocity_to_data, 1 - time, self.action_dim)

    def is_debug_enabled(self) -> bool:
        """Tell LeRobot not to track anything."""
        return False

    def track(self, **values: Any) -> None:
        """Do nothing; `Guide.callback` gets the steps."""


@contextmanager
def velocities_guided(policy: Any, guide: Guide | None, action_dim: int) -> Iterator[None]:
    """Sample from a policy under a guide; without one, or at scale 0, the policy is untouched."""
    if guide is None or not guide.acts:
        yield
        return
    processor, config = policy.model.rtc_processor, policy.config.rtc_config
    policy.model.rtc_processor = VelocityGuide(guide, action_dim)
    policy.config.rtc_config = RTCConfig(enabled=True)  # the model's hook follows its configuration
    try:
        yield
    finally:
        policy.model.rtc_processor, policy.config.rtc_config = processor, config
