"""LeRobot's diffusion model around the denoiser that the configuration names."""

from typing import cast

import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionModel, DiffusionRgbEncoder
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.mlp import MLPDenoiser
from lerobot_agpd.policies.diffusion_transformer.transformer import TransformerDenoiser


class DenoisingModel(DiffusionModel):
    """LeRobot's sampling loop, loss and observation encoders around an exchangeable denoiser."""

    def __init__(self, config: DiffusionTransformerConfig):
        super().__init__(config)
        if config.denoiser != "unet":
            set_denoiser(self, make_denoiser(config, condition_dim(config, self)), config)

    def _prepare_global_conditioning(self, batch: dict[str, Tensor]) -> Tensor:
        return repeat_for_actions(super()._prepare_global_conditioning(batch), batch)


def make_denoiser(config: DiffusionTransformerConfig, width: int) -> nn.Module:
    """Build the denoiser that `config` names, for flattened conditions (B, width)."""
    if config.denoiser == "transformer":
        return TransformerDenoiser(
            horizon=config.horizon,
            action_dim=config.action_dim,
            n_condition_tokens=config.n_obs_steps,
            condition_dim=width // config.n_obs_steps,
            config=config.transformer,
        )
    return MLPDenoiser(config.horizon, config.action_dim, condition_dim=width, config=config.mlp)


def set_denoiser(model: DiffusionModel, denoiser: nn.Module, config: DiffusionTransformerConfig) -> None:
    """Put a denoiser in the place of LeRobot's U-Net, compiled like that with `--policy.compile_model`."""
    if config.compile_model:
        denoiser = cast(nn.Module, torch.compile(denoiser, mode=config.compile_mode))
    model.register_module("unet", denoiser)


def condition_dim(config: DiffusionTransformerConfig, model: DiffusionModel) -> int:
    """Width of the flattened condition: state, environment state and image features of every step."""
    vectors = (config.robot_state_feature, config.env_state_feature)
    dim = sum(feature.shape[0] for feature in vectors if feature is not None)
    if config.image_features:
        encoders = model.rgb_encoder  # one for all cameras, or one per camera
        encoder = encoders[0] if isinstance(encoders, nn.ModuleList) else encoders
        dim += cast(DiffusionRgbEncoder, encoder).feature_dim * len(config.image_features)
    return dim * config.n_obs_steps


def repeat_for_actions(condition: Tensor, batch: dict[str, Tensor]) -> Tensor:
    """Repeat conditions (B, C) where a batch holds k consecutive action chunks per observation.

    Encoding the observation is the expensive part; with k noise levels per frame it is done once instead of k times.

    Returns:
        (k * B, C), one row per row of `batch["action"]`; unchanged without actions, as in sampling.
    """
    if ACTION not in batch:
        return condition
    return condition.repeat_interleave(len(batch[ACTION]) // len(condition), dim=0)
