"""The diffusion student of AGPD."""

from collections.abc import Mapping
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor

from lerobot_agpd.policies.agpd_diffusion.configuration_agpd_diffusion import AGPDDiffusionConfig
from lerobot_agpd.policies.diffusion_transformer.model import condition_dim
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)
from lerobot_agpd.policies.distilled import DistilledPolicy
from lerobot_agpd.replay.normalization import Statistics
from lerobot_agpd.run import RunInfo
from lerobot_agpd.student import PriorChunk


class AGPDDiffusionPolicy(DistilledPolicy, DiffusionTransformerPolicy):  # type: ignore[misc]
    """A diffusion policy distilled from another one, or from itself (Table 1).

    The averaged weights act: they are evaluated, propose chunks while collecting, and teach in self-distillation.
    """

    config: AGPDDiffusionConfig
    config_class = AGPDDiffusionConfig
    name = "agpd_diffusion"
    can_teach_itself = True

    def __init__(
        self,
        config: AGPDDiffusionConfig,
        dataset_stats: Statistics | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        run: RunInfo | None = None,
        **kwargs: Any,
    ):
        """Build the policy and the adversary; without `dataset_meta` it can be evaluated but not trained."""
        run = run or RunInfo.of(config)
        config.select_inputs()
        super().__init__(config, dataset_stats, dataset_meta, run, **kwargs)
        self.init_distillation(dataset_meta, dataset_stats, run)

    @property
    def embedding_dim(self) -> int:
        """Width of the condition: all observations of the history side by side, images encoded."""
        return condition_dim(self.config, self.diffusion)

    def prior_chunk(self, batch: Mapping[str, Tensor]) -> PriorChunk:
        """The clean chunk x0_hat that one denoising step estimates, and the condition.

        Recorded chunks are noised to a random level, as in training, and the estimate is clipped as in sampling.
        Unlike ACT's prior chunk it depends on the recorded chunk: a denoiser has nothing else to denoise.
        """
        inputs = dict(batch)
        if self.config.image_features:
            inputs[OBS_IMAGES] = torch.stack([batch[key] for key in self.config.image_features], dim=-4)
        condition = self.diffusion._prepare_global_conditioning(inputs)  # (B, E)
        clean = batch[ACTION]
        scheduler: Any = self.diffusion.noise_scheduler
        noise = torch.randn_like(clean)
        levels = torch.randint(scheduler.config.num_train_timesteps, clean.shape[:1], device=clean.device)
        noisy = scheduler.add_noise(clean, noise, levels)
        predicted = self.diffusion.unet(noisy, levels, global_cond=condition)
        x0_hat = clean_estimate(scheduler, noisy, predicted, levels)
        return PriorChunk(x0_hat[:, self.config.n_obs_steps - 1 :], condition)

    def snapshot(self) -> PreTrainedPolicy:
        """A plain diffusion policy with the averaged weights (if there are any), in evaluation mode."""
        was_training = self.training
        self.eval()  # swaps the averaged weights in
        weights = {key: value.clone() for key, value in self.diffusion.state_dict().items()}
        self.train(was_training)
        policy = DiffusionTransformerPolicy(self.config)
        policy.diffusion.load_state_dict(weights)
        policy.to(self.config.device)
        return policy.eval().requires_grad_(False)


def clean_estimate(scheduler: Any, noisy: Tensor, predicted: Tensor, levels: Tensor) -> Tensor:
    """x0_hat (B, H, A) from a network's output at noise levels (B,) (DDPM, arXiv:2006.11239, Eq. 15).

    Args:
        scheduler: a diffusers DDPMScheduler or DDIMScheduler.
        noisy: (B, H, A) noised chunks.
        predicted: (B, H, A) network output, noise or clean chunk as `prediction_type` says.
        levels: (B,) diffusion steps.
    """
    x0_hat = predicted
    if scheduler.config.prediction_type == "epsilon":
        abar = scheduler.alphas_cumprod.to(noisy)[levels.to(scheduler.alphas_cumprod.device)].view(-1, 1, 1)
        x0_hat = (noisy - (1 - abar).sqrt() * predicted) / abar.sqrt()
    if scheduler.config.clip_sample:
        limit = scheduler.config.clip_sample_range
        x0_hat = x0_hat.clamp(-limit, limit)
    return x0_hat
