"""Manipulation with several ways in robosuite: the simulation, its experts and which way an episode took."""

import numpy as np
import pytest

pytest.importorskip("robosuite")

from lerobot_agpd.cli.demos import DemosConfig
from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS
from lerobot_agpd.envs.experts.lift_any import EXPERTS
from lerobot_agpd.envs.lift_tasks import TABLE_HEIGHT, TASKS
from lerobot_agpd.envs.robosuite_ways import RobosuiteWaysEnv
from lerobot_agpd.flag_checks import FlagError

LIFT_ANY = TASKS["LiftAny-v0"]


@pytest.fixture(scope="module")
def env():
    env = RobosuiteWaysEnv(task="LiftAny-v0").make_single()
    yield env
    env.close()


def play(env, expert, seed: int) -> tuple[np.ndarray, np.ndarray, bool]:
    """States of robot (T, 9) and cubes (T, 9) before every action, and whether the episode succeeded."""
    env.reset(seed=seed)
    states, done = [], False
    while not done:
        states.append(env.unwrapped.state)
        _, _, terminated, truncated, info = env.step(expert(states[-1]))
        done = terminated or truncated
    agent, cubes = (np.stack([state[key] for state in states]) for key in (AGENT_POS, ENVIRONMENT_STATE))
    return agent, cubes, info["is_success"]


def follower(way: int, seed: int):
    return EXPERTS["LiftAny-v0"].with_ways(np.eye(3)[way]).for_episode(np.random.default_rng(seed))


@pytest.mark.parametrize("way", range(3))
def test_every_cube_is_lifted_and_read_off_the_states(env, way):
    for seed in range(2):
        agent, cubes, success = play(env, follower(way, seed), seed)
        assert success and LIFT_ANY.way_of(agent, cubes) == way
        assert 10 <= len(agent) <= 0.75 * LIFT_ANY.episode_length


@pytest.mark.slow
def test_the_expert_fails_at_no_seed(env):
    for seed in range(30):
        expert = EXPERTS["LiftAny-v0"].for_episode(np.random.default_rng([1, seed]))
        assert play(env, expert, seed)[2], seed


def test_a_seed_determines_the_episode(env):
    env.reset(seed=3)
    env.step(np.ones(7, dtype=np.float32))
    other = RobosuiteWaysEnv(task="LiftAny-v0").make_single()
    first, second = (play(each, follower(1, 0), seed=7) for each in (env, other))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
    assert not np.array_equal(first[1][0], other.reset(seed=8)[0][ENVIRONMENT_STATE])
    other.close()


def test_observations_fit_the_declared_features(env):
    observation, info = env.reset(seed=0)
    features = RobosuiteWaysEnv(task="LiftAny-v0").features
    assert {key: value.shape for key, value in observation.items()} == {
        key: features[key].shape for key in (AGENT_POS, ENVIRONMENT_STATE)
    }
    assert info == {"is_success": False}
    cubes = observation[ENVIRONMENT_STATE].reshape(3, 3) + observation[AGENT_POS][:3]
    np.testing.assert_allclose(cubes[:, :2], LIFT_ANY.cubes, atol=0.0101)
    np.testing.assert_allclose(cubes[:, 2], TABLE_HEIGHT + 0.02, atol=1e-6)


def test_observations_are_those_of_the_current_state(env):
    """robosuite leaves the positions of its last but one step of physics."""
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.array([1.0, 0.5, -0.5, 0.2, 0.1, 0.3, -1.0], dtype=np.float32))
    before = {key: value.copy() for key, value in env.unwrapped.state.items()}
    env.unwrapped.simulation.sim.forward()
    env.unwrapped._read()
    for key, value in before.items():
        np.testing.assert_allclose(env.unwrapped.state[key], value, atol=1e-6)


def test_median_of_the_headings_leads_between_two_cubes(env):
    """And so does their mean to no cube: what a deterministic student of balanced demonstrations does."""
    headings = np.array(LIFT_ANY.cubes) - env.reset(seed=0)[0][AGENT_POS][:2]
    for place in (np.median(headings, axis=0), headings.mean(axis=0)):
        assert np.linalg.norm(headings - place, axis=1).min() > 0.08


def test_coming_down_between_the_cubes_lifts_none(env):
    """Execute the coordinate-wise median of the actions of the three ways, step by step."""
    recorded = []
    for way in range(3):
        env.reset(seed=0)
        expert, actions = follower(way, 0), []
        for _ in range(LIFT_ANY.episode_length):
            actions.append(expert(env.unwrapped.state))
            env.step(actions[-1])
        recorded.append(actions)
    median = iter(np.median(recorded, axis=0).astype(np.float32))
    agent, cubes, success = play(env, lambda observation: next(median), seed=0)
    assert not success
    lowest = agent[:, 2].argmin()
    assert agent[lowest, 2] < TABLE_HEIGHT + 0.05
    assert np.linalg.norm(cubes[lowest].reshape(3, 3)[:, :2], axis=1).min() > 0.06


@pytest.mark.parametrize("seed", range(5))
def test_torques_are_those_of_robosuites_controller(env, seed):
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    for _ in range(5):
        env.step(rng.uniform(-1.0, 1.0, 7).astype(np.float32))
    simulation = env.unwrapped.simulation
    arm = simulation.robots[0].part_controllers["right"]
    simulation.sim.forward()
    arm.update(force=True)
    expected = arm.run_controller()
    actual = simulation._operational_space.torques(simulation.sim.data._data)
    np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-6)
    assert np.abs(expected).max() > 1.0


def test_images_show_the_hand_and_the_cubes(rendering):
    env = RobosuiteWaysEnv(obs_type="pixels", observation_height=40, observation_width=64).make_single()
    first = env.reset(seed=0)[0][PIXELS].copy()
    assert first.shape == (40, 64, 3)
    red, green, blue = (first[..., i].astype(int) for i in range(3))
    for color, others in ((red, (green, blue)), (green, (red, blue)), (blue, (red, green))):
        assert (color > 1.3 * np.maximum(*others)).any()
    for _ in range(5):
        last = env.step(np.array([1.0, 0, 0, 0, 0, 0, 0], dtype=np.float32))[0][PIXELS]
    assert not np.array_equal(first, last)
    env.close()


def test_fractions_of_the_ways(tmp_path):
    config = DemosConfig(tmp_path / "new", RobosuiteWaysEnv(task="LiftAny-v0"), ways=[0.0, 0.0, 1.0])
    vectors = np.array([[*cube, TABLE_HEIGHT + 0.02] for cube in LIFT_ANY.cubes]) - [0.0, 0.0, 0.98]
    observation = {
        AGENT_POS: np.array([0, 0, 0.98, 1, 0, 0, 0, 0.04, -0.04]),
        ENVIRONMENT_STATE: vectors.ravel(),
    }
    for seed in range(10):
        action = config.make_expert().for_episode(np.random.default_rng(seed))(observation)
        assert action[1] < -0.5  # to the cube on the right
    with pytest.raises(FlagError, match=r"--ways=\[.*3 fractions"):
        DemosConfig(tmp_path / "new", RobosuiteWaysEnv(task="LiftAny-v0"), ways=[0.5, 0.5])
