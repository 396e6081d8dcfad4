"""LeRobot's diffusion policy, and every policy derived from it, as a teacher."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor

from lerobot_agpd.flag_checks import require
from lerobot_agpd.guidance.guide import Guide, guided
from lerobot_agpd.guidance.pull import Sampler, diffusion_sampler
from lerobot_agpd.guidance.teacher import Teacher

if TYPE_CHECKING:
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionModel
    from lerobot.policies.multi_task_dit.modeling_multi_task_dit import DiffusionObjective

SCHEDULER_CLASSES: dict[str, type[DDPMScheduler] | type[DDIMScheduler]] = {
    "DDPM": DDPMScheduler,
    "DDIM": DDIMScheduler,
}


class DiffusionTeacher(Teacher):
    """A DiffusionPolicy (arXiv:2303.04137), guided at every step of its noise scheduler.

    Its chunk starts n_obs_steps - 1 steps in the past.
    """

    can_be_guided = True

    @property
    def start(self) -> int:
        """Index of the current step in its internal chunk."""
        return self.n_obs_steps - 1

    @property
    def n_chunk_steps(self) -> int:
        """Steps of a chunk from the current one on."""
        return self.policy.config.horizon - self.start

    @property
    def n_denoising_steps(self) -> int | None:
        """Steps of its scheduler."""
        return self.policy.diffusion.num_inference_steps

    @property
    def resizes_images(self) -> bool:
        """Whether it accepts images of any size."""
        return self.policy.config.resize_shape is not None

    @property
    def sampler(self) -> Sampler | None:
        """The steps of its noise scheduler."""
        model = self.policy.diffusion
        return diffusion_sampler(model.noise_scheduler, model.num_inference_steps)

    def set_sampler(self, num_inference_steps: int | None, noise_scheduler: str | None) -> None:
        """Exchange the scheduler, or the number of its steps."""
        set_diffusion_sampler(self.policy.diffusion, num_inference_steps, noise_scheduler)

    def _sample_chunk(
        self, batch: dict[str, Tensor], guide: Guide | None, generator: torch.Generator | None
    ) -> Tensor:
        model = self.policy.diffusion
        condition = model._prepare_global_conditioning(stack_cameras(self.policy.config, batch))  # (B, C)
        with guided(model, guide):
            return model.conditional_sample(len(condition), global_cond=condition, generator=generator)


def stack_cameras(config: PreTrainedConfig, batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Add the cameras of a batch as one tensor, (B, T, cameras, C, H, W), as LeRobot's encoders read them."""
    cameras = list(config.image_features)
    return {**batch, OBS_IMAGES: torch.stack([batch[key] for key in cameras], dim=-4)} if cameras else batch


def set_diffusion_sampler(
    model: DiffusionModel | DiffusionObjective, num_inference_steps: int | None, noise_scheduler: str | None
) -> None:
    """Exchange the noise scheduler of a model, and the number of its steps; None keeps either.

    Raises:
        FlagError: if there are more steps than the model was trained with.
    """
    if noise_scheduler is not None:
        model.noise_scheduler = SCHEDULER_CLASSES[noise_scheduler].from_config(model.noise_scheduler.config)
    if num_inference_steps is None:
        return
    limit = model.noise_scheduler.config["num_train_timesteps"]
    require(
        num_inference_steps <= limit,
        f"--policy.teacher.num_inference_steps={num_inference_steps} exceeds the {limit} "
        "diffusion steps the teacher was trained with",
    )
    model.num_inference_steps = num_inference_steps
