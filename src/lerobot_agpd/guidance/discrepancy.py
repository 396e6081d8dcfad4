"""The discrepancy J between a teacher's chunk and the student's (section 4.2, appendix A.4).

A discrepancy is a function of the teacher's chunk, (B, H, A) in the teacher's normalized space, that returns
J for every row, (B,). It is differentiable, and the student's chunk is fixed inside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_agpd.guidance.representation import StateRepresentation

Discrepancy = Callable[[Tensor], Tensor]


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
        executed = chunk[:, self.start : self.start + self.target.shape[1]]
        return 0.5 * (executed - self.target).square().sum(dim=(1, 2))


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
        gap = self.representation(self.observation, executed) - self.representation(
            self.observation, self.target
        )
        squared = gap.square().sum(dim=1)
        return squared * self._rescaling(squared, chunk)

    def _rescaling(self, squared: Tensor, chunk: Tensor) -> Tensor:
        """Mean gradient norm of the action J over that of this J; a constant factor."""
        if not chunk.requires_grad:
            return torch.ones((), device=chunk.device)
        own = torch.autograd.grad(squared.sum(), chunk, retain_graph=True)[0].flatten(1).norm(dim=1).mean()
        reference = gradient(self.reference, chunk)[1].flatten(1).norm(dim=1).mean()
        return (reference / own.clamp_min(1e-12)).detach()


def gradient(discrepancy: Discrepancy, chunk: Tensor) -> tuple[Tensor, Tensor]:
    """J, (B,), and its gradient with respect to the chunk, (B, H, A); works inside `no_grad`.

    Inside `inference_mode` no gradient exists; leave it first.
    """
    with torch.enable_grad():
        chunk = chunk.detach().clone().requires_grad_(True)
        value = discrepancy(chunk)
        return value.detach(), torch.autograd.grad(value.sum(), chunk)[0]
