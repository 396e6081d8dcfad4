"""Diagnostics against closed forms."""

import math

import numpy as np
import pytest
import torch
from toy_policies import TEACHER_UNIT, NoisyTeacher, histories, make_pair, noise, student_actions

from lerobot_agpd.collect.config import DiagnosticsConfig, MixingConfig
from lerobot_agpd.collect.deciders.mixing import MixedPolicies
from lerobot_agpd.collect.deciders.teacher import GuidedTeacher, TeacherAlone
from lerobot_agpd.collect.diagnostics import action_diagnostics, action_kl, state_diagnostics
from lerobot_agpd.guidance.config import GuidanceConfig
from lerobot_agpd.replay.episode import Episode, Ticket


def guided(spread=0.5, **options) -> GuidedTeacher:
    return GuidedTeacher(make_pair(NoisyTeacher(spread)), noise(), GuidanceConfig(), **options)


# ---- actions ----


def test_teacher_alone_is_at_no_distance():
    found = action_diagnostics(TeacherAlone(make_pair(), noise()), histories(), 0.0, samples=4, seed=1)
    assert found["observations"] == 5
    assert found["rms_to_teacher"] == 0
    assert found["kl_to_teacher"] == pytest.approx(0, abs=1e-12)
    assert found["rms_to_student"] == found["rms_teacher_to_student"] > 0


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_spread_of_the_teacher_is_that_of_its_samples(spread):
    decider = TeacherAlone(make_pair(NoisyTeacher(spread)), noise())
    found = action_diagnostics(decider, histories(), 0.0, samples=400, seed=1)
    assert found["teacher_spread"] == pytest.approx(spread, rel=0.05)


def test_guided_teacher_lies_where_its_scale_says():
    """Scale 0.25 carries the toy teacher a quarter of the way, whatever its noise."""
    found = action_diagnostics(guided(), histories(), 0.25, samples=8, seed=1)
    whole = found["rms_teacher_to_student"]
    assert found["rms_to_teacher"] == pytest.approx(0.25 * whole, rel=1e-5)
    assert found["rms_to_student"] == pytest.approx(0.75 * whole, rel=1e-5)
    assert found["kl_to_teacher"] > 0


def test_distances_of_a_noiseless_teacher_by_hand():
    history = histories()
    teacher = history["observation.state"][:, -1].sum(dim=1)[:, None, None]
    gap = (student_actions(history) - teacher) / TEACHER_UNIT
    found = action_diagnostics(guided(spread=0.0), history, 1.0, samples=2, seed=1)
    assert found["rms_to_student"] == pytest.approx(0, abs=1e-6)
    assert found["rms_to_teacher"] == pytest.approx(float(gap.square().mean().sqrt()), rel=1e-5)
    # two deterministic policies, blurred by 0.01: KL = gap^2 / (2 * 0.01^2)
    assert found["kl_to_teacher"] == pytest.approx(float(gap.square().mean()) / 2e-4, rel=1e-4)


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
    """Neither noise nor stopwatch nor the running quantile of the strategy notice."""
    history, scale = histories(), torch.full((5,), 0.5)
    untouched, diagnosed = guided(quantile=0.5), guided(quantile=0.5)
    untouched.decide(history, scale), diagnosed.decide(history, scale)
    seconds = dict(diagnosed.stopwatch.seconds)
    first, second = (action_diagnostics(diagnosed, history, 0.5, samples=3, seed=1) for _ in range(2))
    assert first == second and diagnosed.stopwatch.seconds == seconds
    for _ in range(2):
        ours, theirs = untouched.decide(history, scale), diagnosed.decide(history, scale)
        assert torch.equal(ours.actions, theirs.actions)


def test_random_choice_between_both_policies():
    """Half of a switching strategy's chunks are the student's: mean squared distance to either is half of all."""
    decider = MixedPolicies(make_pair(NoisyTeacher(0.0)), noise(), MixingConfig(form="switch"))
    found = action_diagnostics(decider, histories(n=40), 0.5, samples=50, seed=1)
    total = found["rms_to_student"] ** 2 + found["rms_to_teacher"] ** 2
    assert total == pytest.approx(found["rms_teacher_to_student"] ** 2, rel=1e-5)
    assert found["rms_to_student"] ** 2 == pytest.approx(total / 2, rel=0.1)


# ---- states ----

STATS = {"observation.state": {"mean": [10.0, 0.0], "std": [2.0, 1.0]}}


def episode(states, **observations) -> Episode:
    length = len(states)
    return Episode(
        ticket=Ticket(0, 1, 0.0),
        task="",
        observations={"observation.state": np.asarray(states, dtype=np.float32), **observations},
        actions=np.zeros((length, 1), dtype=np.float32),
        rewards=np.zeros(length, dtype=np.float32),
        successes=None,
        j=0.0,
        shift=0.0,
    )


def test_entropy_of_standard_normal_states():
    """Two dimensions: ln(2 pi e) nats; states spread by the statistics' own deviations."""
    normal = np.random.default_rng(0).normal(size=(40, 100, 2))
    episodes = [episode(path * [2.0, 1.0] + [10.0, 0.0]) for path in normal]
    found = state_diagnostics(episodes, STATS, DiagnosticsConfig(states=4000), seed=0)
    assert (found["states"], found["dim"]) == (4000, 2)
    assert found["entropy"] == pytest.approx(math.log(2 * math.pi * math.e), abs=0.06)
    fewer = state_diagnostics(episodes, STATS, DiagnosticsConfig(states=1000), seed=0)
    assert fewer["states"] == 1000
    assert fewer["entropy"] == pytest.approx(found["entropy"], abs=0.12)


def test_coverage_by_hand():
    """Next states at distance 0.69, 0.72 and 0 (in deviations) of the other episode's; 0.5 sqrt(2) is 0.707."""
    first = episode([[10.0, 0.0], [14.0, 0.0], [20.0, 5.0]])
    second = episode([[-90.0, 0.0], [10.0 + 2 * 0.69, 0.0], [14.0, 0.72], [20.0, 5.0]])
    found = state_diagnostics([first, second], STATS, DiagnosticsConfig(), seed=0)
    assert found["coverage"] == pytest.approx(2 / 3)


def test_too_few_states_have_no_number():
    alone = state_diagnostics([episode([[1.0, 2.0]] * 9)], STATS, DiagnosticsConfig(), seed=0)
    assert alone == {"states": 1, "dim": 2, "entropy": None, "coverage": None}
    assert state_diagnostics([], STATS, DiagnosticsConfig(), seed=0) is None


def test_images_and_unknown_features_are_left_out():
    images = np.zeros((4, 8, 8, 3), dtype=np.uint8)
    other = np.zeros((4, 7), dtype=np.float32)
    states = np.random.default_rng(0).normal(size=(4, 2))
    path = episode(states, **{"observation.image": images, "observation.other": other})
    assert state_diagnostics([path], STATS, DiagnosticsConfig(), seed=0)["dim"] == 2
    blind = episode(states)
    blind.observations = {"observation.image": images}
    assert state_diagnostics([blind], STATS, DiagnosticsConfig(), seed=0) is None
