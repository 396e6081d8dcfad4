"""Chunks of unlike horizon, history and normalization, compared on the steps they share."""

from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings, strategies as st
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature

from lerobot_agpd.guidance.teacher_student import TeacherStudent
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.replay.normalization import Normalizer


def maps(mode: str, stats) -> SimpleNamespace:
    """Between raw actions and those of a policy that normalizes in this way."""
    config = AGPDConfig(
        device="cpu",
        input_features={"observation.environment_state": PolicyFeature(FeatureType.ENV, (2,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (len(stats["mean"]),))},
        normalization_mapping={"ACTION": NormalizationMode(mode), "ENV": NormalizationMode("IDENTITY")},
    )
    normalizer = Normalizer(config, {"action": stats})
    return SimpleNamespace(
        normalize=lambda x: normalizer.normalize("action", x),
        unnormalize=lambda x: normalizer.unnormalize("action", x),
    )


def make_pair(teacher, student, n_steps, start) -> TeacherStudent:
    teacher.start = start
    return TeacherStudent(teacher, None, n_steps, student.normalize, student.unnormalize)


@st.composite
def statistics(draw, action_dim):
    vectors = st.lists(st.floats(-50, 50), min_size=action_dim, max_size=action_dim).map(torch.tensor)
    spreads = st.lists(st.floats(0.01, 30), min_size=action_dim, max_size=action_dim).map(torch.tensor)
    low = draw(vectors)
    return {"mean": draw(vectors), "std": draw(spreads), "min": low, "max": low + draw(spreads)}


@st.composite
def pairs(draw):
    """A pair, horizon of the teacher, chunk size of the student, action dimensions."""
    action_dim, n_obs_steps, n_steps = (draw(st.integers(1, most)) for most in (3, 4, 5))
    modes = st.sampled_from(["MIN_MAX", "MEAN_STD", "IDENTITY"])
    teacher, student = (maps(draw(modes), draw(statistics(action_dim))) for _ in range(2))
    pair = make_pair(teacher, student, n_steps, start=n_obs_steps - 1)
    longer = [draw(st.integers(0, 3)) for _ in range(2)]
    return pair, n_obs_steps - 1 + n_steps + longer[0], n_steps + longer[1], action_dim


@given(pairs())
@settings(max_examples=40, deadline=None)
def test_there_and_back_is_identity(case):
    pair, _, chunk_size, action_dim = case
    chunk = torch.randn(2, chunk_size, action_dim, dtype=torch.float64)
    there = pair.student_in_teacher_space(chunk)
    assert there.shape == (2, pair.n_steps, action_dim)
    executed = chunk[:, : pair.n_steps]
    torch.testing.assert_close(pair.teacher_in_student_space(there), executed, rtol=1e-4, atol=1e-2)
    raw = pair.teacher.unnormalize(there)
    torch.testing.assert_close(raw, pair.unnormalize(executed), rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(
        pair.executed_discrepancy(raw, there), torch.zeros(2).double(), atol=1e-3, rtol=0
    )


@given(pairs())
@settings(max_examples=40, deadline=None)
def test_step_k_meets_step_n_obs_minus_1_plus_k(case):
    """A teacher's chunk that is the student's own, one step of it disturbed: J sees that step, at its place."""
    pair, horizon, chunk_size, action_dim = case
    start, student = pair.teacher.start, torch.randn(1, chunk_size, action_dim)
    j = pair.action_discrepancy(student)
    chunk = torch.randn(1, horizon, action_dim) * 100
    for k in range(pair.n_steps):  # the teacher plans the same raw actions at the same moments
        chunk[:, start + k] = pair.teacher.normalize(pair.unnormalize(student[:, k]))
    tolerance = 1e-5 * (1 + float(j.target.square().sum()))
    torch.testing.assert_close(j(chunk), torch.zeros(1), rtol=0, atol=tolerance)
    for k in range(pair.n_steps):
        disturbed = chunk.clone()
        disturbed[:, start + k] += 1.0
        grad = j.gradient(disturbed)[0] - j.gradient(chunk)[0]
        expected = torch.zeros(horizon, action_dim)
        expected[start + k] = 1.0
        torch.testing.assert_close(grad, expected, rtol=0, atol=1e-5 * (1 + float(j.target.abs().max())))


def test_spaces_by_hand():
    """MIN_MAX over [0, 10] against mean 4, deviation 2: the student's 1 is raw 6, is 0.2 for the teacher."""
    stats = {"mean": torch.tensor([4.0]), "std": torch.tensor([2.0])}
    stats |= {"min": torch.tensor([0.0]), "max": torch.tensor([10.0])}
    pair = make_pair(maps("MIN_MAX", stats), maps("MEAN_STD", stats), n_steps=2, start=1)
    chunk = torch.tensor([[[1.0], [-2.0], [77.0]]], requires_grad=True)
    there = pair.student_in_teacher_space(chunk)
    assert there.flatten().tolist() == pytest.approx([0.2, -1.0])
    there.sum().backward()
    assert chunk.grad.flatten().tolist() == pytest.approx([0.4, 0.4, 0.0])
    assert pair.teacher_in_student_space(there).flatten().tolist() == pytest.approx([1.0, -2.0])
