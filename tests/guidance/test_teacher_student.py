"""Chunks of unlike horizon, history and normalisation, compared on the steps they share."""

import pytest
import torch
from hypothesis import given, settings, strategies as st
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature

from lerobot_agpd.guidance.alignment import Alignment
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy, gradient
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.replay.normalisation import Normaliser


def normaliser(mode: str, stats) -> Normaliser:
    action_dim = len(stats["mean"])
    config = AGPDConfig(
        device="cpu",
        input_features={"observation.environment_state": PolicyFeature(FeatureType.ENV, (2,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (action_dim,))},
        normalization_mapping={"ACTION": NormalizationMode(mode), "ENV": NormalizationMode("IDENTITY")},
    )
    return Normaliser(config, {"action": stats})


@st.composite
def statistics(draw, action_dim):
    floats = st.floats(-50, 50)
    spread = st.floats(0.01, 30)
    low = [draw(floats) for _ in range(action_dim)]
    width = [draw(spread) for _ in range(action_dim)]
    return {
        "mean": torch.tensor([draw(floats) for _ in range(action_dim)]),
        "std": torch.tensor([draw(spread) for _ in range(action_dim)]),
        "min": torch.tensor(low),
        "max": torch.tensor([a + b for a, b in zip(low, width, strict=True)]),
    }


@st.composite
def alignments(draw):
    """Alignment, horizon of the teacher, chunk size of the student, action dimensions."""
    action_dim = draw(st.integers(1, 3))
    n_obs_steps = draw(st.integers(1, 4))
    n_steps = draw(st.integers(1, 5))
    modes = st.sampled_from(["MIN_MAX", "MEAN_STD", "IDENTITY"])
    teacher = normaliser(draw(modes), draw(statistics(action_dim)))
    student = normaliser(draw(modes), draw(statistics(action_dim)))
    alignment = Alignment(
        start=n_obs_steps - 1,
        n_steps=n_steps,
        teacher_units=lambda x: teacher.normalise("action", x),
        teacher_raw=lambda x: teacher.unnormalise("action", x),
        student_units=lambda x: student.normalise("action", x),
        student_raw=lambda x: student.unnormalise("action", x),
    )
    horizon = n_obs_steps - 1 + n_steps + draw(st.integers(0, 3))
    return alignment, horizon, n_steps + draw(st.integers(0, 3)), action_dim


@given(alignments())
@settings(max_examples=40, deadline=None)
def test_property_there_and_back_is_identity(case):
    alignment, _, chunk_size, action_dim = case
    chunk = torch.randn(2, chunk_size, action_dim, dtype=torch.float64)
    there = alignment.student_in_teacher_units(chunk)
    assert there.shape == (2, alignment.n_steps, action_dim)
    back = alignment.teacher_in_student_units(there)
    torch.testing.assert_close(back, chunk[:, : alignment.n_steps], rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(
        alignment.teacher_raw(there),
        alignment.student_raw(chunk[:, : alignment.n_steps]),
        rtol=1e-5,
        atol=1e-4,
    )


@given(alignments())
@settings(max_examples=40, deadline=None)
def test_property_step_k_meets_step_n_obs_minus_1_plus_k(case):
    """A teacher's chunk that is the student's own, one step of it disturbed: J sees that step, at its place."""
    alignment, horizon, chunk_size, action_dim = case
    student = torch.randn(1, chunk_size, action_dim)
    target = alignment.student_in_teacher_units(student)
    j = ActionDiscrepancy(target, alignment.start)
    chunk = torch.randn(1, horizon, action_dim) * 100
    for k in range(alignment.n_steps):  # the teacher plans the same raw actions at the same moments
        raw = alignment.student_raw(student[:, k])
        chunk[:, alignment.start + k] = alignment.teacher_units(raw)
    torch.testing.assert_close(
        j(chunk), torch.zeros(1), rtol=0, atol=1e-5 * (1 + float(target.square().sum()))
    )
    for k in range(alignment.n_steps):
        disturbed = chunk.clone()
        disturbed[:, alignment.start + k] += 1.0
        grad = gradient(j, disturbed)[1][0] - gradient(j, chunk)[1][0]
        expected = torch.zeros(horizon, action_dim)
        expected[alignment.start + k] = 1.0
        torch.testing.assert_close(grad, expected, rtol=0, atol=1e-5 * (1 + float(target.abs().max())))


def test_hand_computed_units():
    """MIN_MAX over [0, 10] against mean 4, deviation 2: the student's 1 is raw 6, is 0.2 for the teacher."""
    stats = {"mean": torch.tensor([4.0]), "std": torch.tensor([2.0])}
    stats |= {"min": torch.tensor([0.0]), "max": torch.tensor([10.0])}
    teacher, student = normaliser("MIN_MAX", stats), normaliser("MEAN_STD", stats)
    alignment = Alignment(
        start=1,
        n_steps=2,
        teacher_units=lambda x: teacher.normalise("action", x),
        teacher_raw=lambda x: teacher.unnormalise("action", x),
        student_units=lambda x: student.normalise("action", x),
        student_raw=lambda x: student.unnormalise("action", x),
    )
    chunk = torch.tensor([[[1.0], [-2.0], [77.0]]], requires_grad=True)
    there = alignment.student_in_teacher_units(chunk)
    assert there.flatten().tolist() == pytest.approx([0.2, -1.0])
    there.sum().backward()
    assert chunk.grad.flatten().tolist() == pytest.approx([0.4, 0.4, 0.0])
    assert alignment.teacher_in_student_units(there).flatten().tolist() == pytest.approx([1.0, -2.0])
