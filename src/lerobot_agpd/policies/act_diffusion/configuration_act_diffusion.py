"""Configuration of ACT with a diffusion prediction head."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig

from lerobot_agpd.flag_checks import require
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
    TransformerDenoiserConfig,
)

RESNET_STRIDE = 32
"""Pixels per cell of the feature map that ACT's ResNet returns."""


def _default_head() -> TransformerDenoiserConfig:
    return TransformerDenoiserConfig(width=512, n_layers=4, n_heads=8, attention_dropout=0.1, causal=False)


@PreTrainedConfig.register_subclass("act_diffusion")
@dataclass
class ACTDiffusionConfig(DiffusionTransformerConfig):
    """ACT-DP, the teacher of the paper's Table 5: ACT's encoder and a transformer that denoises the chunk.

    The paper names it in one sentence and gives no sizes. The encoder's defaults are LeRobot's for ACT
    (arXiv:2304.13705), `--policy.transformer.*` is the head, everything else belongs to the diffusion policy.
    Actions are scaled to [-1, 1], where the sampler clips, not standardized as ACT's are.
    """

    # Observations that the policy looks at; must be 1, ACT encodes the current one alone.
    n_obs_steps: int = 1
    # Steps of a predicted chunk (ACT's chunk_size).
    horizon: int = 100
    # Steps executed per prediction.
    n_action_steps: int = 100
    # Frames at an episode's end that no training chunk starts from; none, what lies behind the end is masked.
    drop_n_last_frames: int = 0
    # Leave steps behind an episode's end out of the loss, as ACT does.
    do_mask_loss_for_padding: bool = True

    # Network that denoises; the transformer is the only one that attends to ACT's tokens.
    denoiser: str = "transformer"
    # The prediction head.
    transformer: TransformerDenoiserConfig = field(default_factory=_default_head)

    # Width of ACT's encoder.
    dim_model: int = 512
    # Attention heads of ACT's encoder.
    n_heads: int = 8
    # Width of the encoder's feed-forward layers.
    dim_feedforward: int = 3200
    # Number of the encoder's layers.
    n_encoder_layers: int = 4
    # Normalize before attention and feed-forward layers instead of after.
    pre_norm: bool = False
    # Dropout in ACT's encoder.
    dropout: float = 0.1

    # Learning rate.
    optimizer_lr: float = 1e-4
    # Weight decay of the matrices.
    optimizer_weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.denoiser == "transformer",
            "--policy.denoiser must be 'transformer' for act_diffusion (it attends to ACT's tokens), "
            f"got '{self.denoiser}'",
        )
        require(
            self.n_obs_steps == 1,
            f"--policy.n_obs_steps must be 1, ACT encodes the current observation only; got {self.n_obs_steps}",
        )
        for name in ("resize_shape", "crop_shape", "use_group_norm"):
            value = getattr(self, name)
            require(
                not value,
                f"--policy.{name}={value} belongs to LeRobot's diffusion image encoder; ACT's has no such option, "
                "leave it unset",
            )
        for name in ("dim_model", "n_heads", "dim_feedforward", "n_encoder_layers"):
            value = getattr(self, name)
            require(value >= 1, f"--policy.{name} must be at least 1, got {value}")
        require(
            self.dim_model % self.n_heads == 0 and self.dim_model % 4 == 0,
            f"--policy.dim_model must be a multiple of n_heads={self.n_heads} and of 4 (the positions of an "
            f"image's rows and columns share it), got {self.dim_model}",
        )

    def act_config(self) -> ACTConfig:
        """Configuration of the ACT whose encoder is used: no latent to infer, no decoder."""
        return ACTConfig(
            input_features=self.input_features,
            output_features=self.output_features,
            device=self.device,
            chunk_size=1,
            n_action_steps=1,
            vision_backbone=self.vision_backbone,
            pretrained_backbone_weights=self.pretrained_backbone_weights,
            pre_norm=self.pre_norm,
            dim_model=self.dim_model,
            n_heads=self.n_heads,
            dim_feedforward=self.dim_feedforward,
            n_encoder_layers=self.n_encoder_layers,
            n_decoder_layers=0,
            use_vae=False,
            latent_dim=1,
            dropout=self.dropout,
        )

    @property
    def n_encoder_tokens(self) -> int:
        """Tokens of ACT's encoder: latent, state, environment state, and the cells of every feature map."""
        cells = sum(
            math.ceil(feature.shape[1] / RESNET_STRIDE) * math.ceil(feature.shape[2] / RESNET_STRIDE)
            for feature in self.image_features.values()
        )
        return 2 + (self.env_state_feature is not None) + cells
