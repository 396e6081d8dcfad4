"""LeRobot's multi-task diffusion transformer as a teacher: flow matching, or diffusion."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lerobot_agpd.config import GuidancePoint
from lerobot_agpd.guidance.adapters.diffusion import DiffusionTeacher, set_diffusion_sampler, stack_cameras
from lerobot_agpd.guidance.flow import guided_velocity
from lerobot_agpd.guidance.guide import Guide, guided
from lerobot_agpd.guidance.pull import Sampler, diffusion_sampler, flow_sampler
from lerobot_agpd.guidance.teacher import seeded_by


class MultiTaskDiTTeacher(DiffusionTeacher):
    """A MultiTaskDiTPolicy (arXiv:2507.05331), guided as its objective denoises.

    With `objective=diffusion` the scheduler's steps are shifted as for a diffusion policy, with
    `objective=flow_matching` the velocity is. Its chunk starts n_obs_steps - 1 steps in the past.
    """

    @property
    def n_denoising_steps(self) -> int | None:
        """Steps of the scheduler, or Euler steps of the flow."""
        if self.policy.config.is_diffusion:
            return self.policy.objective.num_inference_steps
        return self.policy.config.num_integration_steps

    @property
    def resizes_images(self) -> bool:
        """Whether it accepts images of any size."""
        return self.policy.config.image_resize_shape is not None

    @property
    def guidance_points(self) -> tuple[GuidancePoint, ...]:
        """Where J can be differentiated: a flow has no posterior mean."""
        return ("x0",) if self.policy.config.is_flow_matching else ("x0", "mu")

    @property
    def sampler(self) -> Sampler | None:
        """The steps of its scheduler, or the Euler steps of its flow; other integrators are of no known form."""
        config, objective = self.policy.config, self.policy.objective
        if config.is_diffusion:
            return diffusion_sampler(objective.noise_scheduler, objective.num_inference_steps)
        return flow_sampler(config.num_integration_steps) if config.integration_method == "euler" else None

    def set_sampler(self, num_inference_steps: int | None, noise_scheduler: str | None) -> None:
        """Exchange the number of steps, and for diffusion the scheduler."""
        if self.policy.config.is_diffusion:
            set_diffusion_sampler(self.policy.objective, num_inference_steps, noise_scheduler)
            return
        if noise_scheduler is not None:
            raise self.no_such_setting("noise_scheduler", noise_scheduler, "integrates a flow")
        if num_inference_steps is not None:
            self.policy.config.num_integration_steps = num_inference_steps

    def _sample_chunk(
        self, batch: dict[str, Tensor], guide: Guide | None, generator: torch.Generator | None
    ) -> Tensor:
        policy = self.policy
        condition = policy.observation_encoder.encode(stack_cameras(policy.config, batch))  # (B, C)
        model = policy.noise_predictor
        if guide is not None and policy.config.is_flow_matching and guide.acts:
            model = GuidedVelocity(model, guide)
        diffusion_guide = guide if policy.config.is_diffusion else None
        with seeded_by(generator), guided(policy.objective, diffusion_guide):
            return policy.objective.conditional_sample(model, len(condition), condition)


class GuidedVelocity(nn.Module):
    """A velocity network under a guide; time runs from 0 (noise) to 1 (data)."""

    def __init__(self, model: nn.Module, guide: Guide):
        super().__init__()
        self.model = model
        self.guide = guide

    def forward(self, x_tau: Tensor, time: Tensor, **condition: Tensor) -> Tensor:
        """Predict the guided velocity, (B, H, A), of chunks (B, H, A) at times (B,), which are all the same."""
        velocity = self.model(x_tau, time, **condition)
        return guided_velocity(self.guide, x_tau, velocity, float(time[0]), x_tau.shape[-1])
