"""LeRobot's diffusion model with the denoiser that the configuration names."""

from typing import Any

import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionModel
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.denoisers import MLPDenoiser
from lerobot_agpd.policies.diffusion_transformer.transformer import TransformerDenoiser


class DenoisingModel(DiffusionModel):
    """LeRobot's sampling loop, loss and observation encoders around an exchangeable denoiser."""

    def __init__(self, config: DiffusionTransformerConfig):
        super().__init__(config)
        if config.denoiser != "unet":
            self.unet = compiled(make_denoiser(config, self), config)

    def _prepare_global_conditioning(self, batch: dict[str, Tensor]) -> Tensor:
        return repeat_for_actions(super()._prepare_global_conditioning(batch), batch)


def make_denoiser(config: DiffusionTransformerConfig, model: DiffusionModel) -> nn.Module:
    """The denoiser that `config` names, sized for the condition of LeRobot's diffusion model."""
    chunk = {"horizon": config.horizon, "action_dim": config.action_feature.shape[0]}
    width = condition_dim(config, model)
    if config.denoiser == "transformer":
        return TransformerDenoiser(
            **chunk,
            n_condition_tokens=config.n_obs_steps,
            condition_dim=width // config.n_obs_steps,
            config=config.transformer,
        )
    return MLPDenoiser(
        **chunk,
        cond_dim=width,
        width=config.mlp.width,
        n_blocks=config.mlp.n_blocks,
        time_embed_dim=config.mlp.time_embed_dim,
    )


def condition_dim(config: DiffusionTransformerConfig, model: DiffusionModel) -> int:
    """Width of the flattened condition: state, environment state and image features of every step."""
    dim = config.robot_state_feature.shape[0]
    if config.env_state_feature is not None:
        dim += config.env_state_feature.shape[0]
    if config.image_features:
        encoder = model.rgb_encoder
        if isinstance(encoder, nn.ModuleList):  # one per camera
            encoder = encoder[0]
        dim += encoder.feature_dim * len(config.image_features)
    return dim * config.n_obs_steps


def compiled(denoiser: nn.Module, config: DiffusionTransformerConfig) -> nn.Module:
    """The denoiser, compiled as LeRobot compiles its U-Net if `--policy.compile_model` asks for it."""
    if not config.compile_model:
        return denoiser
    wrapped: Any = torch.compile(denoiser, mode=config.compile_mode)
    return wrapped


def repeat_for_actions(condition: Tensor, batch: dict[str, Tensor]) -> Tensor:
    """Repeat conditions (B, C) where a batch holds several consecutive action rows per observation.

    Encoding the observation is what costs; with k noise levels per frame it is done once instead of k times.

    Returns:
        (k * B, C), one row per row of `batch["action"]`; unchanged without actions, as in sampling.
    """
    if ACTION not in batch:
        return condition
    return condition.repeat_interleave(len(batch[ACTION]) // len(condition), dim=0)
