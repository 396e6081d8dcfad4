"""Denoisers with the call signature of LeRobot's U-Net: (noisy chunk, diffusion step, condition) -> prediction."""

from __future__ import annotations

import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionSinusoidalPosEmb
from torch import Tensor, nn


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
        cond_dim: width of the condition (observation history, flattened).
        width: width of the residual blocks.
        n_blocks: number of blocks.
        time_embed_dim: width of the diffusion step's embedding.
    """

    def __init__(
        self, horizon: int, action_dim: int, cond_dim: int, width: int, n_blocks: int, time_embed_dim: int
    ):
        super().__init__()
        self.time_embedding = nn.Sequential(
            DiffusionSinusoidalPosEmb(time_embed_dim),
            nn.Linear(time_embed_dim, 2 * time_embed_dim),
            nn.Mish(),
            nn.Linear(2 * time_embed_dim, time_embed_dim),
        )
        self.network = nn.Sequential(
            nn.Linear(horizon * action_dim + time_embed_dim + cond_dim, width),
            *(ResidualBlock(width) for _ in range(n_blocks)),
            nn.LayerNorm(width),
            nn.Mish(),
            nn.Linear(width, horizon * action_dim),
        )

    def forward(self, x: Tensor, timestep: Tensor | int, global_cond: Tensor | None = None) -> Tensor:
        """Predict noise (or the clean chunk).

        Args:
            x: (B, H, A) noisy chunk, teacher-normalised.
            timestep: (B,) diffusion steps.
            global_cond: (B, cond_dim) condition.

        Returns:
            (B, H, A) prediction.
        """
        timestep = torch.as_tensor(timestep, device=x.device).expand(len(x))
        parts = [x.flatten(1), self.time_embedding(timestep)]
        if global_cond is not None:
            parts.append(global_cond)
        return self.network(torch.cat(parts, dim=-1)).view_as(x)
