"""The scripted expert of ALOHA's cube transfer."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_agpd.envs.aloha import AlohaStateEnvConfig
from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE
from lerobot_agpd.envs.experts import make_expert
from lerobot_agpd.envs.experts.aloha import (
    CLOSE,
    GRIPPERS,
    OPEN,
    hand_positions,
    heading_of_sides,
    intend_transfer,
)
from lerobot_agpd.envs.operators import Operator

pytest.importorskip("gym_aloha")
CUBE_QPOS, CUBE_QVEL = slice(16, 23), slice(16, 22)
EXPERT = make_expert(AlohaStateEnvConfig())


@pytest.fixture(scope="module")
def env():
    return AlohaStateEnvConfig().make_single()


def play(env, policy, seed: int, disturb=lambda step: None) -> tuple[list[dict], bool]:
    """Observations of an episode, and whether it succeeded."""
    observation, _ = env.reset(seed=seed)
    observations, done = [observation], False
    while not done:
        disturb(len(observations))
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        done = terminated or truncated
        observations.append(observation)
    return observations, terminated


@pytest.fixture(scope="module")
def episode(env) -> list[dict]:
    """Observations of one successful episode."""
    observations, success = play(env, EXPERT, seed=0)
    assert success
    return observations


@pytest.mark.parametrize("n_episodes", [2, pytest.param(10, marks=pytest.mark.slow)])
def test_expert_succeeds_within_a_third_of_the_time(env, n_episodes):
    outcomes = [play(env, EXPERT, seed) for seed in range(n_episodes)]
    assert sum(success for _, success in outcomes) >= 0.9 * n_episodes
    assert max(len(observations) for observations, _ in outcomes) < 134


@pytest.mark.slow
def test_expert_recovers_from_noise_on_the_joint_targets(env):
    rng = np.random.default_rng(0)

    def shaken(observation):
        return EXPERT(observation) + rng.normal(0.0, 0.02, 14).astype(np.float32)

    assert sum(play(env, shaken, seed)[1] for seed in range(5)) >= 4


@pytest.mark.slow
def test_expert_finds_a_cube_that_was_taken_from_its_hand_and_turned(env):
    physics = env.unwrapped._env.physics
    rng = np.random.default_rng(1)

    def take_away(step):
        if step == 75:
            yaw = Rotation.from_euler("Z", rng.uniform(-np.pi, np.pi)).as_quat(scalar_first=True)
            physics.data.qpos[CUBE_QPOS] = [rng.uniform(0, 0.2), rng.uniform(0.4, 0.6), 0.05, *yaw]
            physics.data.qvel[CUBE_QVEL] = 0

    for seed in range(4):
        observations, success = play(env, EXPERT, seed, take_away)
        assert observations[74][ENVIRONMENT_STATE][2] > 0.03  # it was in the air
        assert success


def test_operators_of_less_skill_succeed_later(env, episode):
    operator = Operator(EXPERT, 0.75, np.random.default_rng(3))
    observations, success = play(env, operator, seed=0)
    assert success and len(observations) > len(episode)


def test_after_the_transfer_the_left_hand_keeps_the_cube_and_the_right_one_draws_back(env):
    observation, _ = env.reset(seed=2)
    simulation = env.unwrapped
    for _ in range(250):  # the simulation itself goes on after a success
        observation, reward, *_ = simulation.step(EXPERT(observation))
    cube = observation[ENVIRONMENT_STATE][:3]
    left, right = hand_positions(observation)
    assert reward == 4
    assert np.linalg.norm(cube - left) < 0.02
    assert np.linalg.norm(cube - right) > 0.08
    assert observation[AGENT_POS][GRIPPERS[1]] > 0.9
    np.testing.assert_allclose(cube, [0, 0.5, 0.15], atol=0.01)


def test_what_it_does_depends_on_the_observation_alone(episode):
    forward = [EXPERT(observation) for observation in episode]
    backward = [EXPERT(observation) for observation in reversed(episode)]
    np.testing.assert_array_equal(forward, backward[::-1])
    assert all(action.dtype == np.float32 and action.shape == (14,) for action in forward)


def test_an_observation_is_not_changed(episode):
    observation = {key: value.copy() for key, value in episode[50].items()}
    EXPERT(observation)
    for key, value in episode[50].items():
        np.testing.assert_array_equal(observation[key], value)


def test_actions_and_intentions_are_within_bounds(env, episode):
    for observation in episode:
        assert env.action_space.contains(EXPERT(observation))
        assert np.abs(intend_transfer(observation)).max() <= 1.0


def test_stages_in_their_order(episode):
    left, right = np.stack([intend_transfer(observation) for observation in episode]).transpose(1, 0, 2)
    assert left[0, 3] == right[0, 3] == OPEN
    assert left[-4, 3] == right[-4, 3] == CLOSE  # both hands have it; then the right one lets go
    first_closing = [int(np.argmax(hand[:, 3] < 0)) for hand in (left, right)]
    assert first_closing[1] < first_closing[0]
    assert right[: first_closing[1], 2].min() == -1  # down to the cube
    assert right[first_closing[1] : first_closing[0], 2].max() == 1  # up with it


@pytest.mark.parametrize("degrees", [-44, -10, 0, 30, 44])
@pytest.mark.parametrize("up", ["", "X", "Y", "XX", "XY"])
def test_heading_of_a_cube_on_any_of_its_sides(degrees, up):
    on_a_side = Rotation.identity()
    for axis in up:
        on_a_side = Rotation.from_euler(axis, 90, degrees=True) * on_a_side
    for quarters in range(4):
        turned = Rotation.from_euler("Z", degrees + 90 * quarters, degrees=True) * on_a_side
        heading = heading_of_sides(turned.as_quat(scalar_first=True))
        assert np.degrees(heading) == pytest.approx(degrees, abs=1e-6)


@pytest.mark.parametrize(("key", "shape"), [(AGENT_POS, "(14,)"), (ENVIRONMENT_STATE, "(7,)")])
def test_batches_are_refused(episode, key, shape):
    with pytest.raises(ValueError, match=f"Expected {key} .* of a single environment"):
        EXPERT({**episode[0], key: episode[0][key][None]})


def test_a_task_without_expert_names_those_with_one():
    with pytest.raises(ValueError, match="AlohaInsertion-v0 .* aloha_state with one: AlohaTransferCube-v0"):
        make_expert(AlohaStateEnvConfig(task="AlohaInsertion-v0"))
