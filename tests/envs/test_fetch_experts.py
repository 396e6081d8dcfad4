"""The scripted Fetch experts."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE
from lerobot_agpd.envs.experts import make_expert
from lerobot_agpd.envs.experts.fetch import (
    CLOSE,
    EXPERTS,
    OPEN,
    fetch_pick_and_place_expert,
    fetch_push_expert,
    fetch_reach_expert,
)
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.robotics_tasks import TASKS


def scene(
    grip=(1.3, 0.7, 0.5), width=0.1, block=(1.3, 0.7, 0.425), goal=(1.4, 0.8, 0.6)
) -> dict[str, np.ndarray]:
    """Raw observation of a Fetch task with an object at rest."""
    grip, block, goal = (np.asarray(position, dtype=np.float32) for position in (grip, block, goal))
    agent = np.concatenate([grip, [width / 2, width / 2], np.zeros(5)]).astype(np.float32)
    state = np.concatenate([block, block - grip, np.zeros(9), goal]).astype(np.float32)
    return {AGENT_POS: agent, ENVIRONMENT_STATE: state}


def play(env, expert, seed: int, noise: float = 0.0) -> tuple[np.ndarray, list[bool]]:
    """Actions (T, 4) of the expert, executed with added noise, and the success after every step."""
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    actions, successes, done = [], [], False
    while not done:
        actions.append(expert(observation))
        executed = np.clip(actions[-1] + noise * rng.standard_normal(4), -1, 1).astype(np.float32)
        observation, _, terminated, truncated, info = env.step(executed)
        done = terminated or truncated
        successes.append(info["is_success"])
    return np.stack(actions), successes


@pytest.mark.parametrize("task", EXPERTS)
def test_expert_ends_at_the_goal(task):
    pytest.importorskip("gymnasium_robotics")
    env = GymnasiumRoboticsEnv(task=task).make_single()
    assert [seed for seed in range(5) if not play(env, EXPERTS[task], seed)[1][-1]] == []


@pytest.mark.slow
@pytest.mark.parametrize("task", EXPERTS)
def test_expert_recovers_from_disturbances(task):
    pytest.importorskip("gymnasium_robotics")
    env = GymnasiumRoboticsEnv(task=task).make_single()
    outcomes = [play(env, EXPERTS[task], seed, noise=0.2)[1][-1] for seed in range(10)]
    assert np.mean(outcomes) >= 0.8


def test_pick_and_place_opens_and_closes_once_and_then_holds():
    pytest.importorskip("gymnasium_robotics")
    env = GymnasiumRoboticsEnv(task="FetchPickAndPlace-v4").make_single()
    for seed in range(2):
        actions, _ = play(env, fetch_pick_and_place_expert, seed)
        assert (np.diff(np.sign(actions[:, 3])) != 0).sum() == 1
        assert np.abs(np.diff(actions[30:], axis=0)).max() < 0.1  # at rest by then


def test_reach_moves_in_proportion_to_the_distance():
    observation = {
        AGENT_POS: np.zeros(10, dtype=np.float32),
        ENVIRONMENT_STATE: np.array([0.02, -0.5, 0.0], dtype=np.float32),
    }
    np.testing.assert_allclose(fetch_reach_expert(observation), [0.2, -1.0, 0.0, 0.0], atol=1e-6)


def test_pick_and_place_stages():
    far = fetch_pick_and_place_expert(scene(grip=(1.2, 0.7, 0.525)))
    np.testing.assert_allclose(far, [1.0, 0.0, 0.0, OPEN], atol=1e-5)  # across, at the safe height, open

    around_block = fetch_pick_and_place_expert(scene(grip=(1.3, 0.7, 0.425)))
    np.testing.assert_allclose(around_block, [0.0, 0.0, 0.0, CLOSE], atol=1e-5)  # wait and close

    held = fetch_pick_and_place_expert(scene(grip=(1.3, 0.7, 0.425), width=0.05, goal=(1.35, 0.7, 0.455)))
    np.testing.assert_allclose(held, [0.5, 0.0, 0.3, CLOSE], atol=1e-5)  # carry

    lost = fetch_pick_and_place_expert(scene(grip=(1.2, 0.7, 0.425), width=0.0))
    assert lost[3] == OPEN and lost[2] > 0  # rise and open again


def test_push_stages():
    start = {"width": 0.0, "block": (1.3, 0.7, 0.425), "goal": (1.5, 0.7, 0.425)}
    beside_low = fetch_push_expert(scene(grip=(1.3, 0.66, 0.425), **start))
    np.testing.assert_allclose(beside_low[:2], 0.0, atol=1e-6)  # would drag the block: rise first
    assert beside_low[2] > 0.5

    above_start = fetch_push_expert(scene(grip=(1.235, 0.7, 0.505), **start))
    assert above_start[2] < -0.5  # come down behind the block

    touching = fetch_push_expert(scene(grip=(1.26, 0.7, 0.425), **start))
    np.testing.assert_allclose(touching, [0.6, 0.0, 0.0, 0.0], atol=1e-4)

    arrived = fetch_push_expert(scene(grip=(1.45, 0.7, 0.425), **{**start, "block": (1.49, 0.7, 0.425)}))
    np.testing.assert_allclose(arrived, 0.0, atol=1e-6)


@pytest.mark.parametrize("task", EXPERTS)
@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_any_observation_gets_a_valid_action_and_always_the_same(task, data):
    numbers = st.floats(-3, 3, width=32)
    spec = TASKS[task]
    observation = {
        AGENT_POS: data.draw(arrays(np.float32, spec.agent_pos_dim, elements=numbers)),
        ENVIRONMENT_STATE: data.draw(arrays(np.float32, spec.environment_state_dim, elements=numbers)),
    }
    before = {key: value.copy() for key, value in observation.items()}
    action = EXPERTS[task](observation)
    assert action.shape == (4,) and action.dtype == np.float32
    assert np.all(np.abs(action) <= 1)
    np.testing.assert_array_equal(action, EXPERTS[task](observation))
    for key, value in before.items():
        np.testing.assert_array_equal(observation[key], value)


def test_batched_observation_is_refused():
    batched = {key: value[None] for key, value in scene().items()}
    with pytest.raises(ValueError, match="single environment"):
        fetch_push_expert(batched)


def test_task_without_expert_is_refused():
    with pytest.raises(
        ValueError,
        match="FetchSlide-v4 has no scripted expert.*FetchReach-v4, FetchPush-v4, FetchPickAndPlace-v4",
    ):
        make_expert(GymnasiumRoboticsEnv(task="FetchSlide-v4"))
