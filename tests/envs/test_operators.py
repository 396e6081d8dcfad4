"""Operators of limited skill."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lerobot_agpd.envs.experts.base import Expert
from lerobot_agpd.envs.experts.fetch import EXPERTS
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.operators import (
    DETOUR_ANGLE,
    PAUSE_RATE,
    PAUSE_STEPS,
    SLIP_RATE,
    SLIP_STEPS,
    SLOWNESS,
    TREMOR,
    TREMOR_CORRELATION,
    Operator,
    bent_path,
)

STILL = np.zeros(4, dtype=np.float32)
FORWARD = np.array([0.2, 0.0, 0.0, 0.5], dtype=np.float32)
AT_ORIGIN = {"agent_pos": np.zeros(10, dtype=np.float32), "environment_state": np.zeros(18, dtype=np.float32)}


def actions_of(action: np.ndarray, skill: float, steps: int, seed: int = 0) -> np.ndarray:
    """(steps, 4) actions of an operator whose expert always wants the same."""
    operator = Operator(Expert(lambda observation: action), skill, np.random.default_rng(seed))
    return np.stack([operator(AT_ORIGIN) for _ in range(steps)])


def test_full_skill_is_the_expert_and_leaves_the_random_numbers_alone():
    rng = np.random.default_rng(3)
    operator = Operator(Expert(lambda observation: FORWARD), 1.0, rng)
    for _ in range(20):
        np.testing.assert_array_equal(operator(AT_ORIGIN), FORWARD)
    assert rng.random() == np.random.default_rng(3).random()


def test_the_same_seed_gives_the_same_actions_and_another_does_not():
    first = actions_of(FORWARD, 0.5, 30, seed=1)
    np.testing.assert_array_equal(first, actions_of(FORWARD, 0.5, 30, seed=1))
    assert not np.array_equal(first, actions_of(FORWARD, 0.5, 30, seed=2))


def test_path_where_the_heading_is_not_turned_is_only_slower():
    action = np.array([0.2, -0.4, 0.6, 0.5])
    slowed = action * [1 - SLOWNESS / 2, 1 - SLOWNESS / 2, 1 - SLOWNESS / 2, 1]
    np.testing.assert_allclose(bent_path(action, np.zeros(3), skill=0.5), slowed)


def test_path_is_turned_most_a_quarter_wave_away():
    # 0.05 m is a quarter of the wavelength: the sine is 1, and at skill 0.5 the heading turns by half the angle.
    bent = bent_path(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.05, 0.0, 0.0]), skill=0.5)
    turn = DETOUR_ANGLE / 2
    np.testing.assert_allclose(bent[:2], (1 - SLOWNESS / 2) * np.array([math.cos(turn), math.sin(turn)]))


@settings(max_examples=100, deadline=None)
@given(
    skill=st.floats(0, 1),
    heading=st.floats(-math.pi, math.pi),
    hand=st.tuples(*[st.floats(-2, 2)] * 3),
)
def test_every_detour_still_leads_forward(skill, heading, hand):
    action = np.array([math.cos(heading), math.sin(heading), 0.3, -1.0])
    bent = bent_path(action, np.array(hand), skill)
    assert bent[:2] @ action[:2] >= (1 - SLOWNESS) * math.cos(DETOUR_ANGLE) - 1e-9
    assert bent[3] == action[3]
    assert 0 < bent[2] <= action[2]


def test_tremor_has_the_stated_size_and_correlation(monkeypatch):
    monkeypatch.setattr("lerobot_agpd.envs.operators.SLIP_RATE", 0.0)
    tremor = actions_of(STILL, 0.5, 8_000)[:, :3].astype(float)
    assert tremor.mean() == pytest.approx(0, abs=0.01)
    assert tremor.std() == pytest.approx(TREMOR / 2, rel=0.03)
    lagged = (tremor[1:] * tremor[:-1]).mean() / tremor.var()
    assert lagged == pytest.approx(TREMOR_CORRELATION, abs=0.03)


def test_pauses_stop_the_motion_for_the_stated_fraction_of_the_time(monkeypatch):
    monkeypatch.setattr("lerobot_agpd.envs.operators.SLIP_RATE", 0.0)
    monkeypatch.setattr("lerobot_agpd.envs.operators.TREMOR", 0.0)
    actions = actions_of(FORWARD, 0.0, 8_000)
    paused = np.all(actions[:, :3] == 0, axis=1)
    np.testing.assert_allclose(actions[:, 3], FORWARD[3])  # the fingers hold on
    np.testing.assert_allclose(actions[~paused, 0], (1 - SLOWNESS) * FORWARD[0], rtol=1e-6)
    # Renewal: (1 - rate) / rate steps of motion on average, then a pause of mean length.
    length = sum(PAUSE_STEPS) / 2
    assert paused.mean() == pytest.approx(length / (length + (1 - PAUSE_RATE) / PAUSE_RATE), rel=0.1)


def test_slips_move_the_hand_off_and_reverse_the_gripper(monkeypatch):
    monkeypatch.setattr("lerobot_agpd.envs.operators.TREMOR", 0.0)
    monkeypatch.setattr("lerobot_agpd.envs.operators.PAUSE_RATE", 0.0)
    actions = actions_of(FORWARD, 0.0, 8_000)
    slipping = actions[:, 3] < 0
    np.testing.assert_allclose(actions[slipping, 3], -FORWARD[3])
    np.testing.assert_allclose(np.linalg.norm(actions[slipping, :3], axis=1), 1, rtol=1e-5)
    length = sum(SLIP_STEPS) / 2
    assert slipping.mean() == pytest.approx(length / (length + (1 - SLIP_RATE) / SLIP_RATE), rel=0.1)


@pytest.mark.parametrize("skill", [-0.1, 1.1, float("nan")])
def test_impossible_skill_is_refused(skill):
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        Operator(Expert(lambda observation: STILL), skill, np.random.default_rng(0))


@pytest.mark.slow
@pytest.mark.parametrize("task", EXPERTS)
def test_less_skill_succeeds_less_often_but_not_never(task):
    pytest.importorskip("gymnasium_robotics")
    env = GymnasiumRoboticsEnv(task=task, episode_length=100).make_single()

    def success_rate(skill: float) -> float:
        outcomes = []
        for seed in range(10):
            env.reset(seed=seed)
            operator = Operator(EXPERTS[task], skill, np.random.default_rng(seed))
            truncated = False
            while not truncated:
                _, _, _, truncated, info = env.step(operator(env.state))
            outcomes.append(info["is_success"])
        return float(np.mean(outcomes))

    expert, poor = success_rate(1.0), success_rate(0.25)
    assert expert == 1.0
    assert 0 < poor < 1.0
