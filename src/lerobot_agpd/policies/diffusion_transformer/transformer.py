"""The transformer denoiser of Diffusion Policy (DP-T, arXiv:2303.04137, section 3.1 and appendix A.2)."""

from __future__ import annotations

import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionSinusoidalPosEmb
from torch import Tensor, nn

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    TransformerDenoiserConfig,
)
from lerobot_agpd.policies.fused_groups import ParameterGroup

INIT_STD = 0.02
"""Standard deviation of every initial matrix and position, as in the authors' transformer_for_diffusion.py."""


class TransformerDenoiser(nn.Module):
    """A decoder over the noisy actions that attends to the diffusion step and to the condition.

        step k ──► sinusoid ─┐
        condition tokens ─► linear ─┴─► + positions ──► MLP ──► memory (B, 1 + C, W)
                                                                    │ cross-attention
        noisy actions ──► linear ──► + positions ──► pre-norm decoder layers ──► norm ──► linear

    Args:
        horizon: steps H of a chunk.
        action_dim: action dimensions A.
        n_condition_tokens: number C of condition tokens.
        condition_dim: width D of a condition token.
        config: size of the network.
        condition_is_history: condition token s is the observation of chunk step s. With `config.causal`
            the action of step i then attends to the observations of steps 0..i only; otherwise to all tokens.
    """

    causal_mask: Tensor | None  # (H, H), True where attention is forbidden
    memory_mask: Tensor | None  # (H, 1 + C), True where attention is forbidden

    def __init__(
        self,
        horizon: int,
        action_dim: int,
        n_condition_tokens: int,
        condition_dim: int,
        config: TransformerDenoiserConfig,
        condition_is_history: bool = True,
    ):
        super().__init__()
        width = config.width
        self.n_condition_tokens = n_condition_tokens
        self.causal = config.causal

        self.step_embedding = DiffusionSinusoidalPosEmb(width)
        self.condition_embedding = nn.Linear(condition_dim, width)
        self.condition_positions = nn.Parameter(torch.empty(1 + n_condition_tokens, width))
        self.condition_encoder = nn.Sequential(
            nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width)
        )

        self.action_embedding = nn.Linear(action_dim, width)
        self.action_positions = nn.Parameter(torch.empty(horizon, width))
        layer = nn.TransformerDecoderLayer(
            d_model=width,
            nhead=config.n_heads,
            dim_feedforward=4 * width,
            dropout=config.attention_dropout,
            activation="gelu",
            batch_first=True,
            norm_first=True,
        )
        self.decoder = nn.TransformerDecoder(layer, config.n_layers, norm=nn.LayerNorm(width))
        self.head = nn.Linear(width, action_dim)
        self.dropout = nn.Dropout(config.dropout)

        hides_observations = config.causal and condition_is_history
        causal_mask = _later(horizon, horizon) if config.causal else None
        memory_mask = _memory_mask(horizon, n_condition_tokens) if hides_observations else None
        self.register_buffer("causal_mask", causal_mask, persistent=False)
        self.register_buffer("memory_mask", memory_mask, persistent=False)
        self._initialize()

    def forward(self, x: Tensor, timestep: Tensor | int, global_cond: Tensor) -> Tensor:
        """Predict the clean chunk (or the noise).

        Args:
            x: (B, H, A) noisy chunk, normalized.
            timestep: (B,) diffusion steps, or one for all.
            global_cond: (B, C * D) condition tokens, flattened.

        Returns:
            (B, H, A) prediction.
        """
        timestep = torch.as_tensor(timestep, device=x.device).expand(len(x))
        step_token = self.step_embedding(timestep).to(x.dtype).unsqueeze(1)  # (B, 1, W)
        condition = self.condition_embedding(global_cond.unflatten(1, (self.n_condition_tokens, -1)))
        memory = torch.cat([step_token, condition], dim=1) + self.condition_positions  # (B, 1 + C, W)
        memory = self.condition_encoder(self.dropout(memory))

        actions = self.dropout(self.action_embedding(x) + self.action_positions)  # (B, H, W)
        decoded = self.decoder(
            actions,
            memory,
            tgt_mask=self.causal_mask,
            memory_mask=self.memory_mask,
            tgt_is_causal=self.causal,
        )
        return self.head(decoded)

    def _initialize(self) -> None:
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=INIT_STD)
                nn.init.zeros_(module.bias)
            elif isinstance(module, nn.MultiheadAttention):
                nn.init.normal_(module.in_proj_weight, std=INIT_STD)
                nn.init.zeros_(module.in_proj_bias)
        nn.init.normal_(self.condition_positions, std=INIT_STD)
        nn.init.normal_(self.action_positions, std=INIT_STD)


def _later(n_steps: int, n_tokens: int) -> Tensor:
    """Mask (n_steps, n_tokens) that hides token j from step i < j."""
    return torch.ones(n_steps, n_tokens, dtype=torch.bool).triu(diagonal=1)


def _memory_mask(horizon: int, n_condition_tokens: int) -> Tensor:
    """Mask (H, 1 + C) that hides later observations; the diffusion step's token is seen by all."""
    step_token = torch.zeros(horizon, 1, dtype=torch.bool)
    return torch.cat([step_token, _later(horizon, n_condition_tokens)], dim=1)


def weight_decay_groups(model: nn.Module) -> list[ParameterGroup]:
    """Split the trainable parameters into matrices of linear and attention layers, and all others.

    The first group takes the optimizer's weight decay; biases, norms, embeddings, positions and convolutions do
    not decay.
    """
    decaying = {
        parameter
        for module in model.modules()
        if isinstance(module, nn.Linear | nn.MultiheadAttention)
        for name, parameter in module.named_parameters(recurse=False)
        if name.endswith("weight")
    }
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    return [
        {"params": [parameter for parameter in trained if parameter in decaying]},
        {"params": [parameter for parameter in trained if parameter not in decaying], "weight_decay": 0.0},
    ]
