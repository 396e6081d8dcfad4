"""Diagnostics against closed forms."""

import math

import numpy as np
import pytest
import torch
from toy_policies import TEACHER_UNIT, NoisyTeacher, histories, make_pair, noise, student_actions

from lerobot_agpd.agpd import GuidedStrategy
from lerobot_agpd.config import GuidanceConfig, MixingConfig
from lerobot_agpd.rollout.diagnostics import MAX_STATES, action_diagnostics, action_kl, state_diagnostics
from lerobot_agpd.rollout.strategies import MixingStrategy, TeacherStrategy


def guided(spread=0.5) -> GuidedStrategy:
    return GuidedStrategy(make_pair(NoisyTeacher(spread)), noise(), GuidanceConfig(scale=1.0))


# ---- actions ----


def test_teacher_alone_is_at_no_distance():
    measured = action_diagnostics(TeacherStrategy(make_pair(), noise()), histories(), 0.0, samples=4, seed=1)
    assert measured["observations"] == 5
    assert measured["rms_to_teacher"] == 0
    assert measured["kl_to_teacher"] == pytest.approx(0, abs=1e-12)
    assert measured["rms_to_student"] == measured["rms_teacher_to_student"] > 0


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_spread_of_the_teacher_is_that_of_its_samples(spread):
    strategy = TeacherStrategy(make_pair(NoisyTeacher(spread)), noise())
    measured = action_diagnostics(strategy, histories(), 0.0, samples=400, seed=1)
    assert measured["teacher_spread"] == pytest.approx(spread, rel=0.05)


def test_guided_teacher_lies_where_its_scale_says():
    """Scale 0.25 carries the toy teacher a quarter of the way, whatever its noise."""
    measured = action_diagnostics(guided(), histories(), 0.25, samples=8, seed=1)
    whole = measured["rms_teacher_to_student"]
    assert measured["rms_to_teacher"] == pytest.approx(0.25 * whole, rel=1e-5)
    assert measured["rms_to_student"] == pytest.approx(0.75 * whole, rel=1e-5)
    assert measured["kl_to_teacher"] > 0


def test_distances_of_a_noiseless_teacher_by_hand():
    history = histories()
    teacher = history["observation.state"][:, -1].sum(dim=1)[:, None, None]
    gap = (student_actions(history) - teacher) / TEACHER_UNIT
    measured = action_diagnostics(guided(spread=0.0), history, 1.0, samples=2, seed=1)
    assert measured["rms_to_student"] == pytest.approx(0, abs=1e-6)
    assert measured["rms_to_teacher"] == pytest.approx(float(gap.square().mean().sqrt()), rel=1e-5)
    # two deterministic policies, blurred by 0.01: KL = gap^2 / (2 * 0.01^2)
    assert measured["kl_to_teacher"] == pytest.approx(float(gap.square().mean()) / 2e-4, rel=1e-4)


def test_divergence_of_known_gaussians():
    """Means (1, 0) apart, standard deviations 1 and 2: 1/2 [tr - d + ln det + gap] in two dimensions."""
    normal = torch.randn(20_000, 1, 1, 2, generator=noise(), dtype=torch.float64)
    shifted = normal + torch.tensor([1.0, 0.0])
    expected = 0.5 * (2 / 4 - 2 + 2 * math.log(4) + 1 / 4)
    assert action_kl(shifted, 2 * normal) == pytest.approx(expected, rel=0.03)


def test_mean_is_over_observations_and_steps():
    """One of 2 observations x 2 steps is displaced by 0.02, between deterministic policies blurred by 0.01."""
    reference = torch.zeros(3, 2, 2, 1)
    actions = reference.clone()
    actions[:, 1, 0] = 0.02
    assert action_kl(actions, reference).tolist() == pytest.approx([0, 0, 2.0, 0], rel=1e-4)


def test_diagnosing_leaves_no_trace():
    """Neither noise nor stopwatch of the strategy change."""
    history, scale = histories(), torch.full((5,), 0.5)
    untouched, diagnosed = guided(), guided()
    untouched.act(history, scale), diagnosed.act(history, scale)
    seconds = dict(diagnosed.stopwatch.seconds)
    first, second = (action_diagnostics(diagnosed, history, 0.5, samples=3, seed=1) for _ in range(2))
    assert first == second and diagnosed.stopwatch.seconds == seconds
    for _ in range(2):
        ours, theirs = untouched.act(history, scale), diagnosed.act(history, scale)
        assert torch.equal(ours.actions, theirs.actions)


def test_random_choice_between_both_policies():
    """Half of a switching strategy's chunks are the student's: mean squared distance to either is half of all."""
    strategy = MixingStrategy(make_pair(NoisyTeacher(0.0)), noise(), MixingConfig(form="switch"))
    measured = action_diagnostics(strategy, histories(n=40), 0.5, samples=50, seed=1)
    total = measured["rms_to_student"] ** 2 + measured["rms_to_teacher"] ** 2
    assert total == pytest.approx(measured["rms_teacher_to_student"] ** 2, rel=1e-5)
    assert measured["rms_to_student"] ** 2 == pytest.approx(total / 2, rel=0.1)


# ---- states ----

STATS = {"observation.state": {"mean": [10.0, 0.0], "std": [2.0, 1.0]}}


def path(states, **observations):
    return {"observation.state": np.asarray(states, dtype=np.float32), **observations}


def test_entropy_of_standard_normal_states():
    """Two dimensions: ln(2 pi e) nats; states spread by the statistics' own deviations."""
    normal = np.random.default_rng(0).normal(size=(40, 100, 2))
    measured = state_diagnostics([path(part * [2.0, 1.0] + [10.0, 0.0]) for part in normal], STATS, seed=0)
    assert (measured["states"], measured["dim"]) == (MAX_STATES, 2)
    assert measured["entropy"] == pytest.approx(math.log(2 * math.pi * math.e), abs=0.1)


def test_coverage_by_hand():
    """Next states at distance 0.69, 0.72 and 0 (in deviations) of the other episode's; 0.5 sqrt(2) is 0.707."""
    first = path([[10.0, 0.0], [14.0, 0.0], [20.0, 5.0]])
    second = path([[-90.0, 0.0], [10.0 + 2 * 0.69, 0.0], [14.0, 0.72], [20.0, 5.0]])
    assert state_diagnostics([first, second], STATS, seed=0)["coverage"] == pytest.approx(2 / 3)


def test_too_few_states_have_no_number():
    alone = state_diagnostics([path([[1.0, 2.0]] * 9)], STATS, seed=0)
    assert alone == {"states": 1, "dim": 2, "entropy": None, "coverage": None}
    assert state_diagnostics([], STATS, seed=0) is None


def test_images_and_unknown_features_are_left_out():
    images = {"observation.image": np.zeros((4, 8, 8, 3), dtype=np.uint8)}
    states = np.random.default_rng(0).normal(size=(4, 2))
    mixed = path(states, **images, **{"observation.other": np.zeros((4, 7), dtype=np.float32)})
    assert state_diagnostics([mixed], STATS, seed=0)["dim"] == 2
    assert state_diagnostics([images], STATS, seed=0) is None
