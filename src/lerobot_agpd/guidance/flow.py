"""Guidance of a flow-matching teacher: its velocity is shifted toward the student's chunk.

A flow carries x_tau = (1 - tau) noise + tau x0 from tau = 0 to 1 along a velocity v, and its estimate of the
clean chunk is x0_hat = x_tau + (1 - tau) v. For Gaussian data of unit variance (real-time chunking,
arXiv:2506.07339, makes the same assumption)

    Var(x0 | x_tau) = r^2 = (1 - tau)^2 / (tau^2 + (1 - tau)^2),

so tilting the teacher by exp(-scale J) shifts the mean of x0 by -scale r^2 grad J to first order. The guided
velocity leads to the shifted chunk:

    v + shift / (1 - tau),    shift = -min(scale r^2, 1) grad J(x0_hat), its rms at most TRUST_REGION * r.

J is never differentiated through the network. An Euler step to tau + dt covers dt / (1 - tau) <= 1 of the way
to the shifted chunk, so that the chain stays bounded at any scale.
"""

from __future__ import annotations

import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_agpd.guidance.guide import Guide, Posterior


def clean_variance(tau: float) -> float:
    """Variance r^2 of the clean entries given the noisy ones at time tau in [0, 1]."""
    return (1 - tau) ** 2 / (tau**2 + (1 - tau) ** 2)


def guided_velocity(guide: Guide, x_tau: Tensor, velocity: Tensor, tau: float, action_dim: int) -> Tensor:
    """Shift a velocity toward the student's chunk.

    Args:
        guide: J and scales; its steps are called with tau.
        x_tau: (B, H, D) the noisy chunk; its first `action_dim` dimensions are actions, the others padding.
        velocity: (B, H, D) dx / dtau as the teacher predicts it, from noise to data.
        tau: time from 0 (noise) to 1 (data).
        action_dim: A, the dimensions that J compares; the others stay unguided.

    Returns:
        (B, H, D) velocity; rows with scale 0 keep theirs bit for bit.
    """
    if tau >= 1:
        return velocity  # the chunk is already clean
    x0_hat = (x_tau + (1 - tau) * velocity)[..., :action_dim]
    step = Posterior(mean=x0_hat, variance=clean_variance(tau), x0_hat=x0_hat)
    shift = guide.shift(step, tau)  # (B, H, A)
    return velocity + F.pad(shift, (0, x_tau.shape[-1] - action_dim)) / (1 - tau)
