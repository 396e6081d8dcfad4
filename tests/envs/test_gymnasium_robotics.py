"""The environment type `gymnasium_robotics`, as LeRobot's own commands use it."""

import pickle
import sys
import warnings
from dataclasses import dataclass
from typing import get_args

import draccus
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from lerobot.envs import EnvConfig, make_env, preprocess_observation
from lerobot.envs.utils import check_env_attributes_and_types, env_to_policy_features
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv, ObsType, Task
from lerobot_agpd.envs.robotics_tasks import KITCHEN, KITCHEN_DEFAULT, OBSERVED_KEYS, TASKS

pytest.importorskip("gymnasium_robotics")


@dataclass
class Command:
    """Options of a command with an environment, such as `lerobot-eval`."""

    env: EnvConfig


def make_vector_env(config: GymnasiumRoboticsEnv, n_envs: int = 2, use_async_envs: bool = False):
    return make_env(config, n_envs=n_envs, use_async_envs=use_async_envs)["gymnasium_robotics"][0]


def roll(env: gym.Env, seed: int, n_steps: int = 20) -> tuple[np.ndarray, list[bool]]:
    """Observations (n_steps + 1, D) and successes under random actions that depend on the seed only."""
    size = (n_steps, *env.action_space.shape)
    actions = np.random.default_rng(seed).uniform(-1, 1, size=size).astype(np.float32)
    observation, info = env.reset(seed=seed)
    observations, successes = [observation], [info["is_success"]]
    for action in actions:
        observation, _, _, _, info = env.step(action)
        observations.append(observation)
        successes.append(info["is_success"])
    return np.stack([np.concatenate([o[AGENT_POS], o[ENVIRONMENT_STATE]]) for o in observations]), successes


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_env_checker_accepts_it(task):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # unbounded observations, and being wrapped at all
        (env,) = make_vector_env(GymnasiumRoboticsEnv(task=task), n_envs=1).envs
        check_env(env, skip_render_check=True)


def test_gymnasium_env_checker_accepts_pixels(rendering):
    config = GymnasiumRoboticsEnv(obs_type="pixels_agent_pos", observation_height=32, observation_width=32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        vector_env = make_vector_env(config, n_envs=1)
        check_env(vector_env.envs[0], skip_render_check=True)
        vector_env.close()


@pytest.mark.parametrize("task", ["FetchPickAndPlace-v4", "AdroitHandPen-v1", KITCHEN])
@pytest.mark.parametrize("use_async_envs", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_vector_env_agrees_with_the_declared_features(use_async_envs, task):
    config = GymnasiumRoboticsEnv(task=task, episode_length=3)
    env = make_vector_env(config, use_async_envs=use_async_envs)
    try:
        assert type(env) is (AsyncVectorEnv if use_async_envs else SyncVectorEnv)
        assert env.call("_max_episode_steps") == (3, 3)
        descriptions = env.call("task_description")
        assert len(descriptions) == 2 and all(descriptions)
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


@pytest.mark.slow
def test_vector_env_of_pixels_agrees_with_the_declared_features(rendering):
    config = GymnasiumRoboticsEnv(
        task="FetchReach-v4", obs_type="pixels_agent_pos", observation_height=48, observation_width=64
    )
    env = make_vector_env(config, use_async_envs=True)
    try:
        observation, _ = env.reset(seed=[5, 6])
        features = env_to_policy_features(config)
        assert set(features) == {ACTION, OBS_STATE, OBS_IMAGE}
        batch = preprocess_observation(observation)
        assert features[OBS_IMAGE].shape == tuple(batch[OBS_IMAGE].shape[1:]) == (3, 48, 64)
        assert not np.array_equal(*observation["pixels"])
        assert [frame.shape for frame in env.call("render")] == [(480, 480, 3)] * 2
    finally:
        env.close()


@pytest.mark.parametrize("task", ["FetchReach-v4", "FetchPickAndPlace-v4", "AdroitHandHammer-v1", KITCHEN])
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


def test_choices_are_those_of_the_tables():
    assert get_args(Task) == tuple(TASKS)
    assert get_args(ObsType) == tuple(OBSERVED_KEYS)


def test_command_line_and_round_trip():
    argv = ["--env.type=gymnasium_robotics", "--env.task=FetchPush-v4", "--env.episode_length=7"]
    config = draccus.parse(Command, args=argv).env
    assert isinstance(config, GymnasiumRoboticsEnv)
    assert config.gym_kwargs["max_episode_steps"] == 7
    assert draccus.decode(EnvConfig, draccus.encode(config, EnvConfig)) == config
    assert pickle.loads(pickle.dumps(config)) == config


def test_defaults_follow_the_task():
    fetch, kitchen = GymnasiumRoboticsEnv(), GymnasiumRoboticsEnv(task=KITCHEN)
    assert (fetch.fps, fetch.episode_length, fetch.tasks_to_complete) == (25, 50, None)
    assert (kitchen.fps, kitchen.episode_length) == (12, 280)
    assert kitchen.tasks_to_complete == list(KITCHEN_DEFAULT)
    argv = ["--env.type=gymnasium_robotics", f"--env.task={KITCHEN}", "--env.tasks_to_complete=[kettle]"]
    assert draccus.parse(Command, args=argv).env.gym_kwargs["tasks_to_complete"] == ["kettle"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "FetchDance-v4"}, "--env.task .*FetchReach-v4, FetchPush-v4.*FetchDance-v4"),
        ({"obs_type": "depth"}, "obs_type must be one of state, pixels, pixels_agent_pos; got 'depth'"),
        ({"observation_width": 0}, "observation_width=0"),
        ({"tasks_to_complete": ["kettle"]}, "belongs to FrankaKitchen-v1, not to FetchPickAndPlace-v4"),
        ({"task": KITCHEN, "tasks_to_complete": ["laundry"]}, "laundry.*bottom burner"),
        ({"task": KITCHEN, "tasks_to_complete": []}, "at least one of"),
        ({"fps": 30}, "fps=30.*25 steps per second"),
        ({"render_mode": "human"}, "render_mode=human"),
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
