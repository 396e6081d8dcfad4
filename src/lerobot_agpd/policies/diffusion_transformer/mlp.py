"""The MLP denoiser: a residual network over the flattened chunk."""

from __future__ import annotations

import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionSinusoidalPosEmb
from torch import Tensor, nn

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import MLPDenoiserConfig

TIME_EMBED_DIM = 64
"""Width of the diffusion step's embedding."""


class ResidualBlock(nn.Module):
    """Pre-norm residual block: x + W2 mish(W1 norm(x))."""

    def __init__(self, width: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, width), nn.Mish(), nn.Linear(width, width)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, width) to (B, width)."""
        return x + self.layers(x)


class MLPDenoiser(nn.Module):
    """Residual MLP over the flattened chunk, as used for low-dimensional tasks in DPPO (arXiv:2409.00588).

    Args:
        horizon: steps H of a chunk.
        action_dim: action dimensions A.
        condition_dim: width C of the condition (observation history, flattened).
        config: size of the network.
    """

    def __init__(self, horizon: int, action_dim: int, condition_dim: int, config: MLPDenoiserConfig):
        super().__init__()
        self.time_embedding = nn.Sequential(
            DiffusionSinusoidalPosEmb(TIME_EMBED_DIM),
            nn.Linear(TIME_EMBED_DIM, 2 * TIME_EMBED_DIM),
            nn.Mish(),
            nn.Linear(2 * TIME_EMBED_DIM, TIME_EMBED_DIM),
        )
        self.network = nn.Sequential(
            nn.Linear(horizon * action_dim + TIME_EMBED_DIM + condition_dim, config.width),
            *(ResidualBlock(config.width) for _ in range(config.n_blocks)),
            nn.LayerNorm(config.width),
            nn.Mish(),
            nn.Linear(config.width, horizon * action_dim),
        )

    def forward(self, x: Tensor, timestep: Tensor | int, global_cond: Tensor) -> Tensor:
        """Predict the clean chunk (or the noise).

        Args:
            x: (B, H, A) noisy chunk, normalized.
            timestep: (B,) diffusion steps, or one for all.
            global_cond: (B, C) condition.

        Returns:
            (B, H, A) prediction.
        """
        timestep = torch.as_tensor(timestep, device=x.device).expand(len(x))
        inputs = [x.flatten(1), self.time_embedding(timestep), global_cond]
        return self.network(torch.cat(inputs, dim=-1)).view_as(x)
