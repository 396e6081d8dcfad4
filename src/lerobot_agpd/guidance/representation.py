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
    """z = E(O_t, A) and O_hat_{t+n} = O_t + D(z) for an observation of N tokens, side by side.

    Low-dimensional observations are one token; the feature maps of cameras (guidance/visual.py) are one per place. E is a
    transformer encoder over observation tokens and n action tokens; z is read from the observation tokens. D is a
    two-layer MLP that predicts the *change* of the observation, token by token, which leaves
    D(E(O, A)) - D(E(O, A_hat)) as it is and makes small motions easy to predict.

    Args:
        observation_dim: D, all features of all tokens side by side.
        action_dim: A.
        n_steps: n, executed steps per chunk.
        n_tokens: N, a divisor of D.
    """

    def __init__(self, observation_dim: int, action_dim: int, n_steps: int, n_tokens: int = 1):
        super().__init__()
        self.n_steps, self.n_tokens = n_steps, n_tokens
        token_dim = observation_dim // n_tokens
        self.observation_token = nn.Linear(token_dim, WIDTH)
        self.action_token = nn.Linear(action_dim, WIDTH)
        self.position = nn.Parameter(torch.randn(n_tokens + n_steps, WIDTH) * 0.02)
        layer = nn.TransformerEncoderLayer(
            WIDTH, N_HEADS, 4 * WIDTH, dropout=0.0, batch_first=True, norm_first=True
        )
        self.encoder = nn.TransformerEncoder(layer, N_LAYERS, enable_nested_tensor=False)
        self.to_latent = nn.Linear(WIDTH, LATENT_DIM)
        self.decoder = nn.Sequential(
            nn.Linear(LATENT_DIM, WIDTH),
            nn.GELU(),
            nn.Linear(WIDTH, token_dim),
        )

    def encode(self, observation: Tensor, actions: Tensor) -> Tensor:
        """The latents z = E(O, A), (B, N, L), for observations (B, D) and executed steps (B, n, A)."""
        observed = self.observation_token(observation.unflatten(1, (self.n_tokens, -1)))
        tokens = torch.cat([observed, self.action_token(actions)], dim=1)
        tokens = tokens + self.position[: tokens.shape[1]]
        *layers, last = self.encoder.layers
        for layer in layers:
            tokens = layer(tokens)
        assert isinstance(last, nn.TransformerEncoderLayer)
        return self.to_latent(_first_tokens(last, tokens, self.n_tokens))

    def forward(self, observation: Tensor, actions: Tensor) -> Tensor:
        """The predicted observation after the executed steps, (B, D)."""
        return observation + self.decoder(self.encode(observation, actions)).flatten(1)


def _first_tokens(layer: nn.TransformerEncoderLayer, tokens: Tensor, n_tokens: int) -> Tensor:
    """The first output tokens (B, N, W) of a layer with norm_first; the others are not computed."""
    normed = layer.norm1(tokens)
    first = (
        tokens[:, :n_tokens] + layer.self_attn(normed[:, :n_tokens], normed, normed, need_weights=False)[0]
    )
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
