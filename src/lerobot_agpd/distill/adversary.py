"""Stage 2's adversary: a discriminator of student and teacher chunks, and the student's loss against it.

D(A | z) is the probability that chunk A was predicted by the *student* at an observation embedded as z. D
minimises cross-entropy; the student minimises log D (Eq. 21). Both happen in one backward pass through a
gradient-reversal layer (arXiv:1409.7495), so one loss and one optimizer serve, and LeRobot's loop stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from lerobot_agpd.distill.config import AdversaryConfig


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
    """Two-layer MLP on (chunk, embedding) whose logit is high for student chunks.

    Args:
        n_steps: compared steps n.
        action_dim: A.
        embedding_dim: E.
        config: sizes.
    """

    def __init__(self, n_steps: int, action_dim: int, embedding_dim: int, config: AdversaryConfig):
        super().__init__()
        wrap: Callable[[nn.Module], nn.Module] = (
            spectral_norm if config.spectral_norm else lambda layer: layer
        )
        self.layers = nn.Sequential(
            wrap(nn.Linear(n_steps * action_dim + embedding_dim, config.width)),
            nn.LeakyReLU(0.2),
            wrap(nn.Linear(config.width, config.width)),
            nn.LeakyReLU(0.2),
            wrap(nn.Linear(config.width, 1)),
        )

    def forward(self, chunk: Tensor, embedding: Tensor) -> Tensor:
        """Logit that the student made the chunk, (B,), for chunks (B, n, A) and embeddings (B, E)."""
        return self.layers(torch.cat([chunk.flatten(1), embedding], dim=1))[:, 0]


@dataclass(frozen=True)
class AdversaryTerms:
    """Terms of the adversarial game; the sum of `discriminator` and `student` is to be minimised.

    Attributes:
        discriminator: D's cross-entropy with its regularisers. Under gradient reversal its gradient with
            respect to the student's chunk already is the one of s * log D.
        student: s times the non-saturating student loss, zero when gradient reversal carries it.
        log_d: mean log D of the student's chunks, L_AIL of Eq. 21; for the log only.
        accuracy: share of chunks that D tells right.
    """

    discriminator: Tensor
    student: Tensor
    log_d: Tensor
    accuracy: Tensor


def adversary_terms(
    discriminator: Discriminator,
    student_chunk: Tensor,
    teacher_chunk: Tensor,
    embedding: Tensor,
    config: AdversaryConfig,
) -> AdversaryTerms:
    """One round of the game.

    The embedding and the teacher's chunks are detached: the student is moved through its chunk alone. Label
    smoothing and gradient penalty act on the teacher's rows only, so they enter D's gradient and no other.

    Args:
        discriminator: D.
        student_chunk: (B, n, A) prior chunks of the student, with gradients.
        teacher_chunk: (B, n, A) the teacher's chunks at the same observations.
        embedding: (B, E) observation embeddings z.
        config: weight s, form and regularisers.
    """
    embedding, teacher_chunk = embedding.detach(), teacher_chunk.detach()
    saturating = config.form == "saturating"
    seen = reverse_gradient(student_chunk, config.weight) if saturating else student_chunk.detach()
    logits_student_is_high = discriminator(seen, embedding)  # (B,) at the student's chunks
    logits_at_teacher = discriminator(teacher_chunk, embedding)  # (B,)
    loss = F.binary_cross_entropy_with_logits(
        logits_student_is_high, torch.ones_like(logits_student_is_high)
    ) + F.binary_cross_entropy_with_logits(
        logits_at_teacher, torch.full_like(logits_at_teacher, config.label_smoothing)
    )
    student_loss = torch.zeros_like(loss)
    if not saturating:
        frozen = {name: value.detach() for name, value in discriminator.named_parameters()}
        logits = torch.func.functional_call(discriminator, frozen, (student_chunk, embedding))
        student_loss = config.weight * F.softplus(logits).mean()  # -log(1 - D)
    if config.gradient_penalty > 0:
        penalty = gradient_penalty(discriminator, teacher_chunk, embedding)
        loss = loss + config.gradient_penalty * penalty
    right = torch.cat([logits_student_is_high > 0, logits_at_teacher < 0])
    return AdversaryTerms(
        discriminator=loss,
        student=student_loss,
        log_d=F.logsigmoid(logits_student_is_high).mean().detach(),
        accuracy=right.float().mean(),
    )


def gradient_penalty(discriminator: Discriminator, chunk: Tensor, embedding: Tensor) -> Tensor:
    """Half the mean squared gradient norm of D's logit with respect to the chunk (R1, arXiv:1801.04406)."""
    chunk = chunk.detach().requires_grad_(True)
    logits = discriminator(chunk, embedding)
    (grad,) = torch.autograd.grad(logits.sum(), chunk, create_graph=True)
    return 0.5 * grad.flatten(1).square().sum(dim=1).mean()
