"""Stage 2's adversary: a discriminator of student and teacher chunks, and the student's loss against it.

D(A | z) is the probability that chunk A was predicted by the *student* at an observation embedded as z. D
minimizes cross-entropy; the student minimizes log D (Eq. 21). Both happen in one backward pass through a
gradient-reversal layer (arXiv:1409.7495), so one loss and one optimizer serve, and LeRobot's loop stays as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

WIDTH = 128
"""Width of D's two hidden layers."""

TEACHER_LABEL = 0.1
"""D's target for teacher chunks: one-sided label smoothing of 0."""

GRADIENT_PENALTY = 1.0
"""Weight of the penalty on the gradient of D's logit at teacher chunks (R1)."""


class _GradientReversal(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, strength: float) -> Tensor:
        ctx.strength = strength
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        return -ctx.strength * grad_outputs[0], None


def reverse_gradient(x: Tensor, strength: float) -> Tensor:
    """Identity whose gradient is multiplied by -strength."""
    return _GradientReversal.apply(x, strength)


class Discriminator(nn.Module):
    """MLP with two hidden layers on (chunk, embedding) whose logit is high for student chunks.

    Args:
        n_steps: compared steps S.
        action_dim: A.
        embedding_dim: E.
    """

    def __init__(self, n_steps: int, action_dim: int, embedding_dim: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(n_steps * action_dim + embedding_dim, WIDTH),
            nn.LeakyReLU(0.2),
            nn.Linear(WIDTH, WIDTH),
            nn.LeakyReLU(0.2),
            nn.Linear(WIDTH, 1),
        )

    def forward(self, chunk: Tensor, embedding: Tensor) -> Tensor:
        """Logit that the student made the chunk, (B,), for chunks (B, S, A) and embeddings (B, E)."""
        return self.layers(torch.cat([chunk.flatten(1), embedding], dim=1))[:, 0]


@dataclass(frozen=True)
class AdversaryBatch:
    """What the discriminator compares the student with at a training step.

    Attributes:
        batch: features of the frames concerned.
        chunk: (B, S, A) the teacher's chunks there, in the student's normalized space.
        compared: (B, S) bool, True on the steps that teacher and student both have.
    """

    batch: Mapping[str, Any]
    chunk: Tensor
    compared: Tensor


@dataclass(frozen=True)
class AdversaryTerms:
    """Terms of the adversarial game.

    Attributes:
        loss: D's cross-entropy with its penalty, to be minimized. Its gradient with respect to the student's chunk
            is that of s * log D, because it is reversed.
        log_d: mean log D of the student's chunks, L_AIL of Eq. 21; for the log only.
        accuracy: fraction of chunks that D tells right; for the log only.
    """

    loss: Tensor
    log_d: Tensor
    accuracy: Tensor


def adversary_terms(
    discriminator: Discriminator,
    student_chunk: Tensor,
    teacher_chunk: Tensor,
    embedding: Tensor,
    weight: float,
) -> AdversaryTerms:
    """One round of the game.

    The embedding and the teacher's chunks are detached: the student is moved through its chunk alone. Label
    smoothing and gradient penalty act on the teacher's rows only, so they enter D's gradient and no other.

    Args:
        discriminator: D.
        student_chunk: (B, S, A) prior chunks of the student, with gradients.
        teacher_chunk: (B, S, A) the teacher's chunks at the same observations.
        embedding: (B, E) observation embeddings z.
        weight: s of Eq. 22.
    """
    embedding, teacher_chunk = embedding.detach(), teacher_chunk.detach()
    logits_student_is_high = discriminator(reverse_gradient(student_chunk, weight), embedding)  # (B,)
    logits_at_teacher = discriminator(teacher_chunk, embedding)  # (B,)
    cross_entropy = F.binary_cross_entropy_with_logits(
        logits_student_is_high, torch.ones_like(logits_student_is_high)
    ) + F.binary_cross_entropy_with_logits(
        logits_at_teacher, torch.full_like(logits_at_teacher, TEACHER_LABEL)
    )
    penalty = gradient_penalty(discriminator, teacher_chunk, embedding)
    told_right = torch.cat([logits_student_is_high > 0, logits_at_teacher < 0])
    return AdversaryTerms(
        loss=cross_entropy + GRADIENT_PENALTY * penalty,
        log_d=F.logsigmoid(logits_student_is_high).mean().detach(),
        accuracy=told_right.float().mean(),
    )


def gradient_penalty(discriminator: Discriminator, chunk: Tensor, embedding: Tensor) -> Tensor:
    """Half the mean squared gradient norm of D's logit with respect to the chunk (R1, arXiv:1801.04406)."""
    chunk = chunk.detach().requires_grad_(True)
    logits = discriminator(chunk, embedding)
    (grad,) = torch.autograd.grad(logits.sum(), chunk, create_graph=True)
    return 0.5 * grad.flatten(1).square().sum(dim=1).mean()
