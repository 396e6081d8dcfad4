"""Configuration of ACT with a diffusion prediction head."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
    TransformerDenoiserConfig,
)


def _default_head() -> TransformerDenoiserConfig:
    return TransformerDenoiserConfig(width=512, n_layers=4, n_heads=8, attention_dropout=0.1, causal=False)


@PreTrainedConfig.register_subclass("act_diffusion")
@dataclass
class ACTDiffusionConfig(DiffusionTransformerConfig):
    """ACT-DP, the teacher of the paper's Table 5: ACT's encoder and a transformer that denoises the chunk.

    The paper names it in one sentence and gives no sizes. The encoder's defaults are LeRobot's for ACT
    (arXiv:2304.13705), `--policy.transformer.*` is the head, everything else belongs to the diffusion policy.
    Actions are scaled to [-1, 1], where the sampler clips, not standardised as ACT's are.
    """

    n_obs_steps: int = 1  # ACT looks at the current observation alone
    horizon: int = 100  # steps of a predicted chunk (ACT's chunk_size)
    n_action_steps: int = 100
    drop_n_last_frames: int = 0  # none: what lies behind an episode's end is masked in the loss, as in ACT
    do_mask_loss_for_padding: bool = True

    denoiser: str = "transformer"  # the only one that attends to ACT's tokens
    transformer: TransformerDenoiserConfig = field(default_factory=_default_head)  # the prediction head

    dim_model: int = 512  # width of ACT's encoder
    n_heads: int = 8  # attention heads of ACT's encoder
    dim_feedforward: int = 3200  # width of its feed-forward layers
    n_encoder_layers: int = 4  # number of its layers
    pre_norm: bool = False  # normalise before attention and feed-forward layers instead of after
    dropout: float = 0.1  # dropout in ACT's encoder
    replace_final_stride_with_dilation: bool = False  # twice the resolution of the ResNet's last feature map

    optimizer_lr: float = 1e-4
    optimizer_weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.denoiser != "transformer":
            raise ValueError(
                f"--policy.denoiser must be 'transformer' for act_diffusion (it attends to ACT's tokens), "
                f"got '{self.denoiser}'"
            )
        if self.n_obs_steps != 1:
            raise ValueError(
                f"--policy.n_obs_steps must be 1, ACT encodes the current observation only; got {self.n_obs_steps}"
            )
        for name in ("resize_shape", "crop_shape", "use_group_norm"):
            if getattr(self, name):
                raise ValueError(
                    f"--policy.{name}={getattr(self, name)} belongs to LeRobot's diffusion image encoder; ACT's has "
                    "no such option, leave it unset"
                )
        for name in ("dim_model", "n_heads", "dim_feedforward", "n_encoder_layers"):
            if getattr(self, name) < 1:
                raise ValueError(f"--policy.{name} must be at least 1, got {getattr(self, name)}")
        if self.dim_model % self.n_heads or self.dim_model % 4:
            raise ValueError(
                f"--policy.dim_model must be a multiple of n_heads={self.n_heads} and of 4 (the positions of an "
                f"image's rows and columns share it), got {self.dim_model}"
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
            replace_final_stride_with_dilation=self.replace_final_stride_with_dilation,
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
        stride = 16 if self.replace_final_stride_with_dilation else 32
        cells = sum(
            math.ceil(ft.shape[1] / stride) * math.ceil(ft.shape[2] / stride)
            for ft in self.image_features.values()
        )
        return 2 + (self.env_state_feature is not None) + cells
