"""The gradient-reversal game against the two-loss game it stands for."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch import nn

from lerobot_agpd.distill.adversary import (
    Discriminator,
    adversary_terms,
    gradient_penalty,
    reverse_gradient,
)
from lerobot_agpd.distill.config import AdversaryConfig

B, N, A, E, OBS = 16, 3, 2, 5, 4
FORMS = ["saturating", "non_saturating"]


class Student(nn.Module):
    def __init__(self):
        super().__init__()
        self.chunk, self.embed = nn.Linear(OBS, N * A), nn.Linear(OBS, E)

    def forward(self, observation):
        return torch.tanh(self.chunk(observation)).view(-1, N, A), self.embed(observation)


def plain(**options) -> AdversaryConfig:
    return AdversaryConfig(
        **{"weight": 0.3, "width": 16, "label_smoothing": 0.0, "gradient_penalty": 0.0, **options}
    )


@pytest.fixture
def game():
    """Observations, teacher chunks, student and discriminator, in double precision."""
    torch.manual_seed(7)
    return (
        torch.randn(B, OBS).double(),
        torch.randn(B, N, A).double().requires_grad_(),
        Student().double(),
        Discriminator(N, A, E, plain()).double(),
    )


def gradients(module):
    return {name: None if p.grad is None else p.grad.clone() for name, p in module.named_parameters()}


def play(game, config):
    """One backward pass of the one-loss game: gradients of student, discriminator, and the terms."""
    observation, teacher_chunk, student, discriminator = game
    student.zero_grad(), discriminator.zero_grad()
    chunk, embedding = student(observation)
    terms = adversary_terms(discriminator, chunk, teacher_chunk, embedding, config)
    (terms.discriminator + terms.student).backward()
    return gradients(student), gradients(discriminator), terms


def two_losses(game, config):
    """The game as printed: D's cross-entropy on detached chunks, then the student's loss with D frozen."""
    observation, teacher_chunk, student, discriminator = game
    student.zero_grad(), discriminator.zero_grad()
    chunk, embedding = (x.detach() for x in student(observation))
    at_student = torch.sigmoid(discriminator(chunk, embedding))
    at_teacher = torch.sigmoid(discriminator(teacher_chunk.detach(), embedding))
    (-at_student.log().mean() - (1 - at_teacher).log().mean()).backward()
    of_discriminator = gradients(discriminator)
    d = torch.sigmoid(discriminator(student(observation)[0], embedding))
    loss = d.log() if config.form == "saturating" else -(1 - d).log()
    (config.weight * loss.mean()).backward()
    return gradients(student), of_discriminator, at_student.log().mean()


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


@pytest.mark.parametrize("form", FORMS)
def test_one_loss_has_the_gradients_of_the_two(game, form):
    config = plain(form=form)
    student, discriminator, terms = play(game, config)
    expected_student, expected_discriminator, log_d = two_losses(game, config)
    assert_same(student, expected_student)
    assert_same(discriminator, expected_discriminator)
    assert student["chunk.weight"].abs().sum() > 0
    assert terms.log_d.item() == pytest.approx(log_d.item())
    assert (terms.student == 0) == (form == "saturating")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("regulariser", [{"label_smoothing": 0.3}, {"gradient_penalty": 5.0}])
def test_regularisers_change_the_discriminators_gradient_only(game, form, regulariser):
    student, discriminator, _ = play(game, plain(form=form))
    student_regularised, discriminator_regularised, _ = play(game, plain(form=form, **regulariser))
    assert_same(student_regularised, student)
    weight = "layers.0.weight"
    assert not torch.allclose(discriminator_regularised[weight], discriminator[weight])


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("spectral_norm", [False, True])
def test_teacher_chunk_and_embedding_get_no_gradient(game, form, spectral_norm):
    observation, teacher_chunk, student, _ = game
    config = plain(form=form, label_smoothing=0.1, gradient_penalty=1.0, spectral_norm=spectral_norm)
    discriminator = Discriminator(N, A, E, config).double()
    gradient, _, _ = play((observation, teacher_chunk, student, discriminator), config)
    assert teacher_chunk.grad is None
    assert gradient["embed.weight"] is None and gradient["chunk.weight"].abs().sum() > 0
    assert all(p.grad is not None for p in discriminator.parameters())


def test_weight_scales_the_students_gradient_and_not_the_discriminators(game):
    student, discriminator, _ = play(game, plain(weight=0.3))
    tripled, same, _ = play(game, plain(weight=0.9))
    assert_same(same, discriminator)
    torch.testing.assert_close(tripled["chunk.weight"], 3 * student["chunk.weight"])


def test_terms_by_hand(game):
    observation, teacher_chunk, student, discriminator = game
    chunk, embedding = student(observation)
    config = plain(label_smoothing=0.2, gradient_penalty=2.0)
    terms = adversary_terms(discriminator, chunk, teacher_chunk, embedding, config)
    at_student, at_teacher = discriminator(chunk, embedding), discriminator(teacher_chunk, embedding)
    entropy = (
        F.softplus(-at_student).mean() + (0.8 * F.softplus(at_teacher) + 0.2 * F.softplus(-at_teacher)).mean()
    )
    penalty = gradient_penalty(discriminator, teacher_chunk, embedding)
    assert terms.discriminator.item() == pytest.approx((entropy + 2 * penalty).item())
    right = ((at_student > 0).sum() + (at_teacher < 0).sum()) / (2 * B)
    assert terms.accuracy.item() == pytest.approx(right.item())


def test_gradient_penalty_by_hand():
    class Linear(nn.Module):
        def forward(self, chunk, embedding):
            return (chunk * torch.arange(1.0, 7.0).view(3, 2)).sum(dim=(1, 2)) + embedding.sum(dim=1)

    penalty = gradient_penalty(Linear(), torch.randn(4, 3, 2), torch.randn(4, 5))
    assert penalty.item() == pytest.approx(0.5 * (1 + 4 + 9 + 16 + 25 + 36))


def test_logit_is_high_for_students_and_the_discriminator_improves():
    config = plain(label_smoothing=0.1, gradient_penalty=0.1)
    discriminator = Discriminator(N, A, E, config)
    optimizer = torch.optim.Adam(discriminator.parameters(), lr=3e-3)
    accuracies, losses = [], []
    for _ in range(150):
        student_chunk, teacher_chunk = torch.randn(2, 64, N, A) * 0.5
        terms = adversary_terms(
            discriminator, student_chunk + 0.5, teacher_chunk - 0.5, torch.randn(64, E), config
        )
        optimizer.zero_grad()
        terms.discriminator.backward()
        optimizer.step()
        accuracies.append(terms.accuracy.item())
        losses.append(terms.discriminator.item())
    assert sum(accuracies[-20:]) / 20 > 0.9 > accuracies[0]
    assert losses[-1] < losses[0]
    assert discriminator(torch.full((1, N, A), 0.5), torch.zeros(1, E)) > 0
    assert discriminator(torch.full((1, N, A), -0.5), torch.zeros(1, E)) < 0


@pytest.mark.parametrize("form", FORMS)
def test_a_student_playing_against_a_fixed_discriminator_approaches_the_teacher(form):
    """D rises along every entry, so teachers are low: descending the student's term lowers its chunk."""

    class Slope(nn.Module):
        def __init__(self):
            super().__init__()
            self.slope = nn.Parameter(torch.ones(()))

        def forward(self, chunk, embedding):
            return self.slope * chunk.sum(dim=(1, 2))

    chunk = torch.zeros(4, N, A, requires_grad=True)
    terms = adversary_terms(Slope(), chunk, torch.full((4, N, A), -1.0), torch.zeros(4, E), plain(form=form))
    (terms.discriminator + terms.student).backward()
    assert (chunk.grad > 0).all()


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        ({"weight": -1}, "weight"),
        ({"form": "hinge"}, "form"),
        ({"start": -1}, "start"),
        ({"width": 0}, "width"),
        ({"lr": 0}, "lr"),
        ({"label_smoothing": 0.5}, "label_smoothing"),
        ({"gradient_penalty": -1}, "gradient_penalty"),
    ],
)
def test_wrong_flags_are_named(options, flag):
    with pytest.raises(ValueError, match=f"--policy.adversary.{flag}"):
        AdversaryConfig(**options)
