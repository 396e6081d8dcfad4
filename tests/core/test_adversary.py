"""The gradient-reversal game against the two-loss game that it stands for."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch import nn

from lerobot_agpd import adversary
from lerobot_agpd.adversary import (
    GRADIENT_PENALTY,
    TEACHER_LABEL,
    Discriminator,
    adversary_terms,
    gradient_penalty,
    reverse_gradient,
)

B, N, A, E, OBS = 16, 3, 2, 5, 4
WEIGHT = 0.3


class Student(nn.Module):
    def __init__(self):
        super().__init__()
        self.chunk, self.embed = nn.Linear(OBS, N * A), nn.Linear(OBS, E)

    def forward(self, observation):
        return torch.tanh(self.chunk(observation)).view(-1, N, A), self.embed(observation)


@pytest.fixture
def game():
    """Observations, teacher chunks, student and discriminator, in double precision."""
    torch.manual_seed(7)
    observation, teacher_chunk = torch.randn(B, OBS).double(), torch.randn(B, N, A).double()
    return observation, teacher_chunk.requires_grad_(), Student().double(), Discriminator(N, A, E).double()


@pytest.fixture
def plain(monkeypatch):
    """Cross-entropy alone, as the paper prints it."""
    monkeypatch.setattr(adversary, "TEACHER_LABEL", 0.0)
    monkeypatch.setattr(adversary, "GRADIENT_PENALTY", 0.0)


def gradients(module):
    return {name: None if p.grad is None else p.grad.clone() for name, p in module.named_parameters()}


def play(game, weight=WEIGHT):
    """One backward pass of the one-loss game: gradients of student and discriminator, and the terms."""
    observation, teacher_chunk, student, discriminator = game
    student.zero_grad(), discriminator.zero_grad()
    chunk, embedding = student(observation)
    terms = adversary_terms(discriminator, chunk, teacher_chunk, embedding, weight)
    terms.loss.backward()
    return gradients(student), gradients(discriminator), terms


def two_losses(game):
    """The game as printed: D's cross-entropy on detached chunks, then the student's s * log D with D frozen."""
    observation, teacher_chunk, student, discriminator = game
    student.zero_grad(), discriminator.zero_grad()
    chunk, embedding = (x.detach() for x in student(observation))
    at_student = torch.sigmoid(discriminator(chunk, embedding))
    at_teacher = torch.sigmoid(discriminator(teacher_chunk.detach(), embedding))
    (-at_student.log().mean() - (1 - at_teacher).log().mean()).backward()
    of_discriminator = gradients(discriminator)
    log_d = torch.sigmoid(discriminator(student(observation)[0], embedding)).log().mean()
    (WEIGHT * log_d).backward()
    return gradients(student), of_discriminator, log_d


def assert_same(ours, theirs):
    for name, gradient in theirs.items():
        if gradient is None:
            assert ours[name] is None, name
        else:
            torch.testing.assert_close(ours[name], gradient, rtol=1e-9, atol=1e-12)


def test_reversal_by_hand():
    x = torch.tensor([1.0, 2.0], requires_grad=True)
    y = reverse_gradient(x, 0.5)
    assert torch.equal(y, x)
    (y * torch.tensor([3.0, -4.0])).sum().backward()
    assert x.grad.tolist() == [-1.5, 2.0]


def test_one_loss_has_the_gradients_of_the_two(game, plain):
    student, discriminator, terms = play(game)
    expected_student, expected_discriminator, log_d = two_losses(game)
    assert_same(student, expected_student)
    assert_same(discriminator, expected_discriminator)
    assert student["chunk.weight"].abs().sum() > 0
    assert terms.log_d.item() == pytest.approx(log_d.item())


@pytest.mark.parametrize("regularizer", ["TEACHER_LABEL", "GRADIENT_PENALTY"])
def test_regularizers_change_the_discriminators_gradient_only(game, plain, monkeypatch, regularizer):
    student, discriminator, _ = play(game)
    monkeypatch.setattr(adversary, regularizer, 0.3)
    student_regularized, discriminator_regularized, _ = play(game)
    assert_same(student_regularized, student)
    weight = "layers.0.weight"
    assert not torch.allclose(discriminator_regularized[weight], discriminator[weight])


def test_teacher_chunk_and_embedding_get_no_gradient(game):
    gradient, of_discriminator, _ = play(game)
    assert game[1].grad is None
    assert gradient["embed.weight"] is None and gradient["chunk.weight"].abs().sum() > 0
    assert all(value is not None for value in of_discriminator.values())


def test_weight_scales_the_students_gradient_and_not_the_discriminators(game):
    student, discriminator, _ = play(game)
    tripled, same, _ = play(game, weight=3 * WEIGHT)
    assert_same(same, discriminator)
    torch.testing.assert_close(tripled["chunk.weight"], 3 * student["chunk.weight"])


def test_terms_by_hand(game):
    observation, teacher_chunk, student, discriminator = game
    chunk, embedding = student(observation)
    terms = adversary_terms(discriminator, chunk, teacher_chunk, embedding, WEIGHT)
    at_student, at_teacher = discriminator(chunk, embedding), discriminator(teacher_chunk, embedding)
    of_teacher = (1 - TEACHER_LABEL) * F.softplus(at_teacher) + TEACHER_LABEL * F.softplus(-at_teacher)
    entropy = F.softplus(-at_student).mean() + of_teacher.mean()
    penalty = gradient_penalty(discriminator, teacher_chunk, embedding)
    assert terms.loss.item() == pytest.approx((entropy + GRADIENT_PENALTY * penalty).item())
    right = ((at_student > 0).sum() + (at_teacher < 0).sum()) / (2 * B)
    assert terms.accuracy.item() == pytest.approx(right.item())


def test_gradient_penalty_by_hand():
    class Linear(nn.Module):
        def forward(self, chunk, embedding):
            return (chunk * torch.arange(1.0, 7.0).view(3, 2)).sum(dim=(1, 2)) + embedding.sum(dim=1)

    penalty = gradient_penalty(Linear(), torch.randn(4, 3, 2), torch.randn(4, 5))
    assert penalty.item() == pytest.approx(0.5 * (1 + 4 + 9 + 16 + 25 + 36))


def train_discriminator(steps=60):
    """D after some steps on separable chunks, students around 0.5 and teachers around -0.5; loss and accuracy."""
    discriminator = Discriminator(N, A, E)
    optimizer = torch.optim.Adam(discriminator.parameters(), lr=3e-3)
    history = []
    for _ in range(steps):
        student_chunk, teacher_chunk = torch.randn(2, 64, N, A) * 0.5 + torch.tensor([0.5, -0.5]).view(
            2, 1, 1, 1
        )
        terms = adversary_terms(discriminator, student_chunk, teacher_chunk, torch.randn(64, E), WEIGHT)
        optimizer.zero_grad()
        terms.loss.backward()
        optimizer.step()
        history.append((terms.loss.item(), terms.accuracy.item()))
    return discriminator, history


def test_the_discriminator_improves_and_its_logit_is_high_for_students():
    discriminator, history = train_discriminator()
    losses, accuracies = zip(*history, strict=True)
    assert sum(accuracies[-10:]) / 10 > 0.9 > accuracies[0]
    assert losses[-1] < losses[0]
    at_student, at_teacher = (discriminator(torch.full((1, N, A), x), torch.zeros(1, E)) for x in (0.5, -0.5))
    assert at_student > 0 > at_teacher


def test_the_student_moves_toward_the_teacher():
    discriminator, _ = train_discriminator()
    chunk, teacher_chunk = torch.full((1, N, A), 0.5), torch.full((1, N, A), -0.5)
    gaps = []
    for _ in range(10):
        chunk = chunk.detach().requires_grad_()
        terms = adversary_terms(discriminator, chunk, teacher_chunk, torch.zeros(1, E), weight=1.0)
        chunk = chunk - 0.2 * torch.autograd.grad(terms.loss, chunk)[0]
        gaps.append((chunk - teacher_chunk).norm().item())
    assert gaps == sorted(gaps, reverse=True) and gaps[-1] < 0.8 * gaps[0]
