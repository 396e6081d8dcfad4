"""ACT's encoder with a diffusion prediction head."""

from copy import copy
from typing import Any

from lerobot.configs import FeatureType
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.act.modeling_act import ACT
from lerobot.policies.diffusion.modeling_diffusion import DiffusionModel
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from torch import Tensor, nn

from lerobot_agpd.policies.act_diffusion.configuration_act_diffusion import ACTDiffusionConfig
from lerobot_agpd.policies.diffusion_transformer.model import repeat_for_actions, set_denoiser
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)
from lerobot_agpd.policies.diffusion_transformer.transformer import TransformerDenoiser
from lerobot_agpd.replay.normalization import Statistics
from lerobot_agpd.run import RunInfo


class EncoderTokens(nn.Module):
    """Replacement of ACT's decoder that returns the encoder's tokens with their positions added."""

    def forward(
        self, x: Tensor, encoder_out: Tensor, decoder_pos_embed: Tensor, encoder_pos_embed: Tensor
    ) -> Tensor:
        """Map tokens (S, B, D) and positions (S, 1, D) to their sum; queries `x` are ignored."""
        return encoder_out + encoder_pos_embed


def make_act_encoder(config: ACTDiffusionConfig) -> ACT:
    """Build LeRobot's ACT with its encoder's tokens, (B, n_encoder_tokens, dim_model), in place of actions."""
    act = ACT(config.act_config())
    act.register_module("decoder", EncoderTokens())
    act.register_module("action_head", nn.Identity())
    act.decoder_pos_embed.requires_grad_(False)  # unused
    return act


class ACTDiffusionModel(DiffusionModel):
    """LeRobot's sampling loop and loss around a transformer that attends to ACT's encoder tokens."""

    def __init__(self, config: ACTDiffusionConfig):
        features = config.input_features or {}
        without_images = copy(config)
        without_images.input_features = {
            key: feature for key, feature in features.items() if feature.type is not FeatureType.VISUAL
        }
        super().__init__(without_images)  # no image encoder of its own: ACT's reads the images
        self.config = config
        self.act = make_act_encoder(config)
        head = TransformerDenoiser(
            horizon=config.horizon,
            action_dim=config.action_dim,
            n_condition_tokens=config.n_encoder_tokens,
            condition_dim=config.dim_model,
            config=config.transformer,
            condition_is_history=False,
        )
        set_denoiser(self, head, config)

    def _prepare_global_conditioning(self, batch: dict[str, Tensor]) -> Tensor:
        """Encode the current observation, (B, 1, ...) per feature, to (B, n_encoder_tokens * dim_model)."""
        observation: dict[str, Tensor | list[Tensor]] = {OBS_STATE: batch[OBS_STATE][:, 0]}
        if self.config.env_state_feature is not None:
            observation[OBS_ENV_STATE] = batch[OBS_ENV_STATE][:, 0]
        if self.config.image_features:
            observation[OBS_IMAGES] = list(batch[OBS_IMAGES][:, 0].unbind(dim=1))  # (B, C, H, W) per camera
        tokens, _ = self.act(observation)
        return repeat_for_actions(tokens.flatten(1), batch)


class ACTDiffusionPolicy(DiffusionTransformerPolicy):
    """ACT-DP: ACT (arXiv:2304.13705) that denoises its chunk instead of regressing it."""

    config_class = ACTDiffusionConfig
    name = "act_diffusion"
    model_class = ACTDiffusionModel

    def __init__(
        self,
        config: ACTDiffusionConfig,
        dataset_stats: Statistics | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        run: RunInfo | None = None,
        **kwargs: Any,
    ):
        """Build the policy; with `dataset_meta` its frames are loaded into memory at the first training step."""
        super().__init__(config, dataset_stats, dataset_meta, run, **kwargs)
