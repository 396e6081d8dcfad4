"""The discrepancy J between a teacher's chunk and the student's (section 4.2, appendix A.4).

A discrepancy is a function of the teacher's chunk, (B, H, A) in the teacher's normalized space, that returns
J for every row, (B,), and knows its gradient. The student's chunk is fixed inside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from lerobot_agpd.guidance.representation import StateRepresentation


class Discrepancy(Protocol):
    """J as guidance needs it."""

    def __call__(self, chunk: Tensor) -> Tensor:
        """J of every row, (B,), for chunks (B, H, A)."""

    def gradient(self, chunk: Tensor) -> Tensor:
        """What guidance follows downhill: the gradient of J with respect to the chunk, (B, H, A), up to one factor."""


@dataclass(frozen=True)
class ActionDiscrepancy:
    """J = 1/2 ||A - A_hat||^2 over the executed steps: the ablation without a learned representation.

    Attributes:
        target: (B, n, A) the student's executed steps A_hat in the teacher's normalized space.
        start: index of the current step in the teacher's chunk.
    """

    target: Tensor
    start: int

    def __call__(self, chunk: Tensor) -> Tensor:
        """J of every row, (B,), for chunks (B, H, A)."""
        return 0.5 * self._gap(chunk).square().sum(dim=(1, 2))

    def gradient(self, chunk: Tensor) -> Tensor:
        """A - A_hat on the executed steps, 0 elsewhere, (B, H, A)."""
        grad = torch.zeros_like(chunk)
        grad[:, self.start : self.start + self.target.shape[1]] = self._gap(chunk)
        return grad

    def _gap(self, chunk: Tensor) -> Tensor:
        return chunk[:, self.start : self.start + self.target.shape[1]] - self.target


@dataclass(frozen=True)
class StateDiscrepancy:
    """J = ||D(E(O, A)) - D(E(O, A_hat))||^2: how far apart the futures are that two chunks lead to (A.4).

    The gradient is rescaled to the mean norm of ActionDiscrepancy's gradient, so that one guidance scale means
    the same for both.

    Attributes:
        representation: the predictor of future observations.
        observation: (B, D) current observation in the student's normalized space.
        target: (B, n, A) the student's executed steps in the student's normalized space.
        to_student: differentiable map of actions from the teacher's to the student's normalized space.
        reference: ActionDiscrepancy of the same two chunks.
    """

    representation: StateRepresentation
    observation: Tensor
    target: Tensor
    to_student: Callable[[Tensor], Tensor]
    reference: ActionDiscrepancy

    def __call__(self, chunk: Tensor) -> Tensor:
        """J of every row, (B,), for chunks (B, H, A)."""
        start, n_steps = self.reference.start, self.target.shape[1]
        executed = self.to_student(chunk[:, start : start + n_steps])
        gap = self.representation(self.observation, executed) - self._target_future
        return gap.square().sum(dim=1)

    @cached_property
    def _target_future(self) -> Tensor:
        """What the student's steps lead to, (B, D): predicted once, not at every denoising step."""
        with torch.no_grad():
            return self.representation(self.observation, self.target)

    def gradient(self, chunk: Tensor) -> Tensor:
        """The gradient, (B, H, A), times one factor for the batch; works inside `no_grad`.

        Inside `inference_mode` no gradient exists; leave it first.
        """
        with torch.enable_grad():
            point = chunk.detach().requires_grad_(True)
            (grad,) = torch.autograd.grad(self(point).sum(), point)
        own, wanted = (
            values.flatten(1).norm(dim=1).mean() for values in (grad, self.reference.gradient(chunk))
        )
        return grad * (wanted / own.clamp_min(1e-12))
