"""The environment type `gymnasium_robotics`, as LeRobot's own commands use it."""

import pickle
import sys
import warnings
from dataclasses import dataclass

import draccus
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from lerobot.envs import EnvConfig, make_env, preprocess_observation
from lerobot.envs.utils import check_env_attributes_and_types, env_to_policy_features
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_agpd.envs.gymnasium_robotics import (
    AGENT_POS,
    ENVIRONMENT_STATE,
    TASKS,
    GymnasiumRoboticsEnv,
    ObservationLayout,
)

pytest.importorskip("gymnasium_robotics")

ENVIRONMENT_STATE_DIM = {
    "FetchReach-v4": 3,
    "FetchPush-v4": 18,
    "FetchPickAndPlace-v4": 18,
    "FetchSlide-v4": 18,
}


@dataclass
class Command:
    """Options of a command with an environment, such as `lerobot-eval`."""

    env: EnvConfig


def make_vector_env(config: GymnasiumRoboticsEnv, n_envs: int = 2, use_async_envs: bool = False):
    return make_env(config, n_envs=n_envs, use_async_envs=use_async_envs)["gymnasium_robotics"][0]


def roll(env: gym.Env, seed: int, n_steps: int = 20) -> tuple[np.ndarray, list[bool]]:
    """Observations (n_steps + 1, D) and successes under random actions that depend on the seed only."""
    actions = np.random.default_rng(seed).uniform(-1, 1, size=(n_steps, 4)).astype(np.float32)
    observation, info = env.reset(seed=seed)
    observations, successes = [observation], [info["is_success"]]
    for action in actions:
        observation, _, _, _, info = env.step(action)
        observations.append(observation)
        successes.append(info["is_success"])
    return np.stack([np.concatenate([o[AGENT_POS], o[ENVIRONMENT_STATE]]) for o in observations]), successes


def test_layout_splits_by_index_and_appends_the_goal():
    layout = ObservationLayout(agent_pos=(0, 3), environment_state=(2,), goal_dim=1)
    split = layout.split({"observation": np.arange(4.0), "desired_goal": np.array([9.0])})
    np.testing.assert_array_equal(split[AGENT_POS], np.float32([0, 3]))
    np.testing.assert_array_equal(split[ENVIRONMENT_STATE], np.float32([2, 9]))
    assert split[AGENT_POS].dtype == split[ENVIRONMENT_STATE].dtype == np.float32


@pytest.mark.parametrize("task", TASKS)
def test_split_observation_holds_what_its_names_say(task):
    env = GymnasiumRoboticsEnv(task=task).make_single()
    observation, _ = env.reset(seed=3)
    raw = env.unwrapped
    assert observation[AGENT_POS].shape == (10,)
    assert observation[ENVIRONMENT_STATE].shape == (ENVIRONMENT_STATE_DIM[task],)
    grip = raw._utils.get_site_xpos(raw.model, raw.data, "robot0:grip")
    np.testing.assert_allclose(observation[AGENT_POS][:3], grip, rtol=1e-6)
    np.testing.assert_allclose(observation[ENVIRONMENT_STATE][-3:], raw.goal, rtol=1e-6)
    if raw.has_object:
        block = raw._utils.get_site_xpos(raw.model, raw.data, "object0")
        np.testing.assert_allclose(observation[ENVIRONMENT_STATE][:3], block, rtol=1e-6)
        np.testing.assert_allclose(observation[ENVIRONMENT_STATE][3:6], block - grip, atol=1e-6)


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_env_checker_accepts_it(task):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # unbounded observations, and being wrapped at all
        check_env(GymnasiumRoboticsEnv(task=task).make_single(), skip_render_check=True)


@pytest.mark.parametrize("use_async_envs", [False, True], ids=["sync", "async"])
def test_vector_env_agrees_with_the_declared_features(use_async_envs):
    config = GymnasiumRoboticsEnv(episode_length=3)
    env = make_vector_env(config, use_async_envs=use_async_envs)
    try:
        assert type(env) is (AsyncVectorEnv if use_async_envs else SyncVectorEnv)
        assert env.call("_max_episode_steps") == (3, 3)
        assert env.call("task_description") == (TASKS[config.task].description,) * 2
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env_attributes_and_types(env)

        observation, info = env.reset(seed=[5, 6])
        assert info["is_success"].dtype == bool
        features = env_to_policy_features(config)
        batch = preprocess_observation(observation)
        assert {key: tuple(value.shape[1:]) for key, value in batch.items()} == {
            key: features[key].shape for key in (OBS_STATE, OBS_ENV_STATE)
        }
        assert env.single_action_space.shape == features[ACTION].shape

        for step in range(3):
            _, _, _, truncated, info = env.step(env.action_space.sample())
            ended = info["final_info"] if step == 2 else info
            assert ended["is_success"].dtype == bool and ended["is_success"].shape == (2,)
            assert truncated.tolist() == [step == 2] * 2

        # The same seeds give what a single environment gives: workers are not seeded in some other way.
        observation, _ = env.reset(seed=[5, 6])
        single, _ = config.make_single().reset(seed=6)
        np.testing.assert_array_equal(observation[ENVIRONMENT_STATE][1], single[ENVIRONMENT_STATE])
    finally:
        env.close()


@pytest.mark.parametrize("task", ["FetchReach-v4", "FetchPickAndPlace-v4"])
def test_seed_determines_the_episode_also_in_a_used_env(task):
    config = GymnasiumRoboticsEnv(task=task)
    used = config.make_single()
    first, _ = roll(used, seed=1)
    other, _ = roll(used, seed=2)
    again, _ = roll(used, seed=1)
    fresh, _ = roll(config.make_single(), seed=1)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, fresh)
    assert not np.array_equal(first, other)


def test_success_is_a_bool_and_means_within_five_centimetres():
    config = GymnasiumRoboticsEnv(task="FetchReach-v4")
    env = config.make_single()
    seen = set()
    for seed in range(30):
        observations, successes = roll(env, seed, n_steps=5)
        distances = np.linalg.norm(observations[:, :3] - observations[:, -3:], axis=1)
        assert all(type(success) is bool for success in successes)
        assert successes == (distances < 0.05).tolist()
        seen.update(successes)
    assert seen == {True, False}


def test_no_renderer_is_opened_unless_asked_for():
    env = GymnasiumRoboticsEnv().make_single()
    roll(env, seed=0)
    assert env.unwrapped.mujoco_renderer.viewer is None


def test_command_line_and_round_trip():
    argv = ["--env.type=gymnasium_robotics", "--env.task=FetchPush-v4", "--env.episode_length=7"]
    config = draccus.parse(Command, args=argv).env
    assert isinstance(config, GymnasiumRoboticsEnv)
    assert config.gym_kwargs["max_episode_steps"] == 7
    assert draccus.decode(EnvConfig, draccus.encode(config, EnvConfig)) == config
    assert pickle.loads(pickle.dumps(config)) == config


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "FetchDance-v4"}, "FetchDance-v4.*Known tasks: FetchReach-v4, FetchPush-v4"),
        ({"obs_type": "pixels"}, "obs_type"),
        ({"fps": 30}, "25 steps per second"),
        ({"episode_length": 0}, "episode_length"),
    ],
)
def test_what_it_cannot_do_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        GymnasiumRoboticsEnv(**options)


def test_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lerobot_policy_agpd\[fetch\]'"):
        make_vector_env(GymnasiumRoboticsEnv())
