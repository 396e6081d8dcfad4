"""The representation of appendix A.4: predict the observation after the executed steps of a chunk."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lerobot_agpd.guidance.config import RepresentationConfig


class StateRepresentation(nn.Module):
    """z = E(O_t, A) and O_hat_{t+n} = O_t + D(z) for low-dimensional observations.

    E is a transformer encoder over one observation token and n action tokens; z is read from the observation
    token. D is a two-layer MLP that predicts the *change* of the observation, which leaves
    D(E(O, A)) - D(E(O, A_hat)) as it is and makes small motions easy to predict.

    Args:
        observation_dim: D, all low-dimensional observation features side by side.
        action_dim: A.
        n_steps: n, executed steps per chunk.
        config: sizes.
    """

    def __init__(self, observation_dim: int, action_dim: int, n_steps: int, config: RepresentationConfig):
        super().__init__()
        self.n_steps = n_steps
        self.observation_token = nn.Linear(observation_dim, config.width)
        self.action_token = nn.Linear(action_dim, config.width)
        self.position = nn.Parameter(torch.randn(1 + n_steps, config.width) * 0.02)
        layer = nn.TransformerEncoderLayer(
            config.width, config.n_heads, 4 * config.width, dropout=0.0, batch_first=True, norm_first=True
        )
        self.encoder = nn.TransformerEncoder(layer, config.n_layers, enable_nested_tensor=False)
        self.to_latent = nn.Linear(config.width, config.latent_dim)
        self.decoder = nn.Sequential(
            nn.Linear(config.latent_dim, config.width),
            nn.GELU(),
            nn.Linear(config.width, observation_dim),
        )

    def encode(self, observation: Tensor, actions: Tensor) -> Tensor:
        """The latent z = E(O, A), (B, L), for observations (B, D) and executed steps (B, n, A)."""
        tokens = torch.cat([self.observation_token(observation)[:, None], self.action_token(actions)], dim=1)
        return self.to_latent(self.encoder(tokens + self.position[: tokens.shape[1]])[:, 0])

    def forward(self, observation: Tensor, actions: Tensor) -> Tensor:
        """The predicted observation after the executed steps, (B, D)."""
        return observation + self.decoder(self.encode(observation, actions))


def reconstruction_loss(predicted: Tensor, future: Tensor, is_pad: Tensor) -> Tensor:
    """||O_hat_{t+n} - O_{t+n}||^2 per feature, averaged over the rows whose future lies in the episode.

    Args:
        predicted: (B, D).
        future: (B, D).
        is_pad: (B,) True where t + n is beyond the episode's end.
    """
    valid = (~is_pad).float()
    squared = (predicted - future).square().mean(dim=1)
    return (squared * valid).sum() / valid.sum().clamp_min(1)
