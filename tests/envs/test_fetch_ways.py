"""Fetch tasks with several ways: the simulation, its experts and which way an episode took."""

import numpy as np
import pytest

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE
from lerobot_agpd.envs.experts.fetch_ways import EXPERTS
from lerobot_agpd.envs.fetch_ways import FetchWaysEnv
from lerobot_agpd.envs.fetch_ways_tasks import TASKS

pytest.importorskip("gymnasium_robotics")


def make(task: str):
    return FetchWaysEnv(task=task).make_single()


def play(env, policy, seed: int) -> tuple[dict[str, np.ndarray], np.ndarray, bool]:
    """Observations (T, ...) before every action (T, 4), and whether the episode succeeded."""
    env.reset(seed=seed)
    observations, actions, done = [], [], False
    while not done:
        observations.append(env.state)
        actions.append(policy(env.state))
        _, _, terminated, truncated, info = env.step(actions[-1])
        done = terminated or truncated
    episode = {key: np.stack([each[key] for each in observations]) for key in observations[0]}
    return episode, np.stack(actions), info["is_success"]


def take(env, way: int, seed: int):
    """An episode of the expert on one way; see `play`."""
    expert = EXPERTS[env.task].with_ways(np.eye(TASKS[env.task].n_ways)[way])
    return play(env, expert.for_episode(np.random.default_rng([way, seed])), seed)


def all_ways(env, seed: int) -> np.ndarray:
    """Actions (n_ways, T, 4) of the expert on every way from the same start, as long as the shortest."""
    episodes = [take(env, way, seed)[1] for way in range(TASKS[env.task].n_ways)]
    length = min(len(actions) for actions in episodes)
    return np.stack([actions[:length] for actions in episodes])


def replay(env, actions: np.ndarray, seed: int):
    """Play actions (T, 4), then stand still; see `play`."""
    standing_still = np.append(np.zeros(3, dtype=np.float32), actions[-1, 3])
    remaining = iter(actions)
    return play(env, lambda observation: next(remaining, standing_still), seed)


@pytest.mark.parametrize("n_seeds", [2, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.parametrize("task", TASKS)
def test_every_way_is_taken_and_read_off_the_observations(task, n_seeds):
    env, spec = make(task), TASKS[task]
    for way in range(spec.n_ways):
        for seed in range(n_seeds):
            episode, _, success = take(env, way, seed)
            assert success and spec.way_of(episode[AGENT_POS], episode[ENVIRONMENT_STATE]) == way
            assert len(episode[AGENT_POS]) <= 0.85 * spec.episode_length


def test_standing_still_is_no_success():
    for task in TASKS:
        env = make(task)
        episode, _, success = play(env, lambda observation: np.zeros(4, dtype=np.float32), seed=0)
        assert not success and len(episode[AGENT_POS]) == TASKS[task].episode_length


def test_median_of_three_blocks_grasps_nothing():
    """And neither does the mean: what a deterministic student of balanced demonstrations does."""
    env = make("PickAnyBlock-v0")
    for average in (np.median, np.mean):
        for seed in range(3):
            actions = average(all_ways(env, seed), axis=0).astype(np.float32)
            episode, _, success = replay(env, actions, seed)
            blocks = episode[ENVIRONMENT_STATE].reshape(-1, 2, 3, 3)
            assert not success and np.ptp(blocks[:, 0, :, 2], axis=0).max() < 0.02  # no block left the table
            assert episode[AGENT_POS][:, 2].min() < 0.48  # the hand came down, though
            lowest = episode[AGENT_POS][:, 2].argmin()
            assert np.linalg.norm(blocks[lowest, 1, :, :2], axis=-1).min() > 0.06


def test_median_of_three_places_brings_the_block_to_none():
    env, spec = make("PickAndPlaceAnyPlace-v0"), TASKS["PickAndPlaceAnyPlace-v0"]
    for average in (np.median, np.mean):
        actions = average(all_ways(env, seed=0), axis=0).astype(np.float32)
        episode, _, success = replay(env, actions, seed=0)
        block = episode[ENVIRONMENT_STATE][:, :3]
        assert not success and block[:, 2].max() > 0.55  # it was lifted
        np.testing.assert_allclose(block[-1, 1], spec.blocks[0][1], atol=0.05)  # and came down in the middle


def test_median_of_three_places_brings_the_hand_to_none():
    env = make("ReachAnyPlace-v0")
    for average in (np.median, np.mean):
        actions = average(all_ways(env, seed=0), axis=0).astype(np.float32)
        episode, _, success = replay(env, actions, seed=0)
        start, end = episode[AGENT_POS][[0, -1], :3]
        assert not success and end[2] < 0.46  # it came down
        np.testing.assert_allclose(end[1], start[1], atol=0.03)


def test_mean_of_both_sides_runs_into_the_block():
    env = make("PushEitherSide-v0")
    actions = np.mean(all_ways(env, seed=0), axis=0).astype(np.float32)
    episode, _, success = replay(env, actions, seed=0)
    block = episode[ENVIRONMENT_STATE][:, 0]
    assert not success and block[-1] < block[0] - 0.01  # away from the place


def test_a_seed_determines_the_episode():
    for task in TASKS:
        env, other = make(task), make(task)
        other.reset(seed=3)
        other.step(np.ones(4, dtype=np.float32))
        episodes = [take(each, way=0, seed=7)[0] for each in (env, other)]
        for key in (AGENT_POS, ENVIRONMENT_STATE):
            np.testing.assert_array_equal(episodes[0][key], episodes[1][key])
        assert not np.array_equal(episodes[0][ENVIRONMENT_STATE][0], env.reset(seed=8)[0][ENVIRONMENT_STATE])


def test_the_way_cannot_be_seen_at_the_start():
    for task in TASKS:
        env = make(task)
        starts = [take(env, way, seed=1)[0][ENVIRONMENT_STATE][0] for way in range(TASKS[task].n_ways)]
        np.testing.assert_array_equal(starts, [starts[0]] * len(starts))


def test_environment_state_holds_places_and_blocks():
    env = make("ReachAnyPlace-v0")
    observation, info = env.reset(seed=0)
    places = observation[ENVIRONMENT_STATE].reshape(3, 3) + observation[AGENT_POS][:3]
    np.testing.assert_allclose(places, TASKS["ReachAnyPlace-v0"].places, atol=1e-6)
    assert info == {"is_success": False}

    env = make("PickAndPlaceAnyPlace-v0")
    scene = env.reset(seed=0)[0][ENVIRONMENT_STATE]
    places = scene[-9:].reshape(3, 3) + scene[:3]
    np.testing.assert_allclose(places, TASKS["PickAndPlaceAnyPlace-v0"].places, atol=1e-6)

    env = make("PickAnyBlock-v0")
    observation, _ = env.reset(seed=0)
    blocks, from_grip = observation[ENVIRONMENT_STATE].reshape(2, 3, 3)
    np.testing.assert_allclose(blocks, TASKS["PickAnyBlock-v0"].blocks, atol=0.0151)
    np.testing.assert_allclose(from_grip, blocks - observation[AGENT_POS][:3], atol=1e-6)


def test_images_show_the_places(rendering):
    for task in TASKS:
        env = make(task)
        env.reset(seed=0)
        marked = env.render().copy()
        model, _ = env.scene()
        for i in range(len(TASKS[task].places)):
            model.site(f"place_{i}").rgba[3] = 0.0
            unmarked = env.render().copy()
            assert not np.array_equal(marked, unmarked)
            marked = unmarked
        env.close()
