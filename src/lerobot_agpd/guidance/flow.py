"""Guidance of a flow-matching teacher: the velocity is bent toward the student.

A flow carries x_tau = (1 - tau) noise + tau x0 from tau = 0 to 1 along a velocity v, and its estimate of the
clean chunk is x0_hat = x_tau + (1 - tau) v. For Gaussian data of unit variance (real-time chunking,
arXiv:2506.07339, makes the same assumption)

    Var(x0 | x_tau) = r^2 = (1 - tau)^2 / (tau^2 + (1 - tau)^2),

so tilting the teacher by exp(-scale J) moves the mean of x0 by -scale r^2 grad J to first order. Guided, the
velocity leads to the moved chunk:

    v + shift / (1 - tau),    shift = -min(scale r^2, 1) grad J(x0_hat), its rms at most trust_region * r.

J is never differentiated through the network. An Euler step to tau + dt moves by dt / (1 - tau) <= 1 toward the
moved chunk, so that the chain stays bounded whatever the scale.
"""

from __future__ import annotations

import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_agpd.guidance.guide import Guide, Posterior


def clean_variance(tau: float) -> float:
    """r^2, the variance of the clean entries given the noisy ones at time tau in [0, 1]."""
    return (1 - tau) ** 2 / (tau**2 + (1 - tau) ** 2)


def guided_velocity(guide: Guide, x: Tensor, velocity: Tensor, tau: float, action_dim: int) -> Tensor:
    """The velocity under a guide.

    Args:
        guide: J, scales and trust region; its steps are called with tau.
        x: (B, H, D) the noisy chunk; its first `action_dim` dimensions are actions, the others padding.
        velocity: (B, H, D) dx / dtau as the teacher predicts it.
        tau: time from 0 (noise) to 1 (data).
        action_dim: A, the dimensions that J compares; the others stay unguided.

    Returns:
        (B, H, D); rows with scale 0 keep their velocity bit for bit.
    """
    if tau >= 1:
        return velocity  # nothing is left to decide
    x0_hat = (x + (1 - tau) * velocity)[..., :action_dim]
    step = Posterior(mean=x0_hat, variance=clean_variance(tau), x0_hat=x0_hat)
    shift = guide.shift(step, tau)  # (B, H, A)
    return velocity + F.pad(shift, (0, x.shape[-1] - action_dim)) / (1 - tau)
