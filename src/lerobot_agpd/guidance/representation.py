"""The representation of appendix A.4: predict the observation after the executed steps of a chunk."""

from __future__ import annotations

import torch
from torch import Tensor, nn

WIDTH, N_LAYERS, N_HEADS = 128, 2, 4
"""Of the transformer encoder: token width, layers, attention heads."""

LATENT_DIM = 32
"""Dimensions L of the latent z."""

WEIGHT = 1.0
"""Weight of the reconstruction loss in the training objective."""

LR = 1e-3
"""Learning rate of the representation."""


class StateRepresentation(nn.Module):
    """z = E(O_t, A) and O_hat_{t+n} = O_t + D(z) for low-dimensional observations.

    E is a transformer encoder over one observation token and n action tokens; z is read from the observation
    token. D is a two-layer MLP that predicts the *change* of the observation, which leaves
    D(E(O, A)) - D(E(O, A_hat)) as it is and makes small motions easy to predict.

    Args:
        observation_dim: D, all low-dimensional observation features side by side.
        action_dim: A.
        n_steps: n, executed steps per chunk.
    """

    def __init__(self, observation_dim: int, action_dim: int, n_steps: int):
        super().__init__()
        self.n_steps = n_steps
        self.observation_token = nn.Linear(observation_dim, WIDTH)
        self.action_token = nn.Linear(action_dim, WIDTH)
        self.position = nn.Parameter(torch.randn(1 + n_steps, WIDTH) * 0.02)
        layer = nn.TransformerEncoderLayer(
            WIDTH, N_HEADS, 4 * WIDTH, dropout=0.0, batch_first=True, norm_first=True
        )
        self.encoder = nn.TransformerEncoder(layer, N_LAYERS, enable_nested_tensor=False)
        self.to_latent = nn.Linear(WIDTH, LATENT_DIM)
        self.decoder = nn.Sequential(
            nn.Linear(LATENT_DIM, WIDTH),
            nn.GELU(),
            nn.Linear(WIDTH, observation_dim),
        )

    def encode(self, observation: Tensor, actions: Tensor) -> Tensor:
        """The latent z = E(O, A), (B, L), for observations (B, D) and executed steps (B, n, A)."""
        tokens = torch.cat([self.observation_token(observation)[:, None], self.action_token(actions)], dim=1)
        tokens = tokens + self.position[: tokens.shape[1]]
        *layers, last = self.encoder.layers
        for layer in layers:
            tokens = layer(tokens)
        assert isinstance(last, nn.TransformerEncoderLayer)
        return self.to_latent(_first_token(last, tokens))

    def forward(self, observation: Tensor, actions: Tensor) -> Tensor:
        """The predicted observation after the executed steps, (B, D)."""
        return observation + self.decoder(self.encode(observation, actions))


def _first_token(layer: nn.TransformerEncoderLayer, tokens: Tensor) -> Tensor:
    """The first output token (B, W) of a nn.TransformerEncoderLayer with norm_first, without computing the others."""
    normed = layer.norm1(tokens)
    first = tokens[:, 0] + layer.self_attn(normed[:, :1], normed, normed, need_weights=False)[0][:, 0]
    return first + layer.linear2(layer.activation(layer.linear1(layer.norm2(first))))


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
