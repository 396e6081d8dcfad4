"""The environment type `robosuite_robomimic`, as LeRobot's own commands use it."""

import pickle
import sys
import warnings
from dataclasses import dataclass
from typing import get_args

import draccus
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from lerobot.envs import EnvConfig, make_env, preprocess_observation
from lerobot.envs.utils import check_env_attributes_and_types, env_to_policy_features
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE
from lerobot_agpd.envs.robomimic import ObsType, RobomimicEnvConfig, Task
from lerobot_agpd.envs.robomimic_tasks import OBSERVED_KEYS, TASKS

pytest.importorskip("robosuite")


@dataclass
class Command:
    """Options of a command with an environment, such as `lerobot-eval`."""

    env: EnvConfig


def slow_unless(task: str, *quick: str):
    return task if task in quick else pytest.param(task, marks=pytest.mark.slow)


@pytest.mark.parametrize("task", [slow_unless(task, "lift") for task in TASKS])
def test_gymnasium_env_checker_accepts_it(task):
    (env,) = make_env(RobomimicEnvConfig(task=task))["robosuite_robomimic"][0].envs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # unbounded observations, and being wrapped at all
        check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.slow
def test_gymnasium_env_checker_accepts_pixels(rendering):
    config = RobomimicEnvConfig(obs_type="pixels", observation_height=24, observation_width=32)
    (env,) = make_env(config)["robosuite_robomimic"][0].envs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("use_async_envs", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_vector_env_agrees_with_the_declared_features(use_async_envs):
    config = RobomimicEnvConfig(task="lift", episode_length=2)
    env = make_env(config, n_envs=2, use_async_envs=use_async_envs)["robosuite_robomimic"][0]
    try:
        assert env.call("_max_episode_steps") == (2, 2)
        assert env.call("task_description") == (TASKS["lift"].description,) * 2
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env_attributes_and_types(env)
        observation, info = env.reset(seed=[5, 6])
        assert info["is_success"].tolist() == [False, False]
        features = env_to_policy_features(config)
        batch = preprocess_observation(observation)
        assert set(batch) == {OBS_STATE, OBS_ENV_STATE} == set(features) - {ACTION}
        assert all(tuple(batch[key].shape[1:]) == features[key].shape for key in batch)
        assert env.single_action_space.shape == features[ACTION].shape
        env.step(env.action_space.sample())
        _, _, _, truncated, info = env.step(env.action_space.sample())
        assert truncated.all() and info["final_info"]["is_success"].tolist() == [False, False]

        # The same seed gives what a single environment gives: workers are not seeded in some other way.
        observation, _ = env.reset(seed=[5, 6])
        single = config.make_single()
        np.testing.assert_array_equal(
            observation[ENVIRONMENT_STATE][1], single.reset(seed=6)[0][ENVIRONMENT_STATE]
        )
        single.close()
    finally:
        env.close()


def test_every_camera_becomes_a_feature():
    config = RobomimicEnvConfig(task="transport", obs_type="pixels_agent_pos", observation_height=24)
    features = env_to_policy_features(config)
    assert features[OBS_STATE].shape == (18,)
    assert {key: feature.shape for key, feature in features.items() if "images" in key} == {
        f"observation.images.{camera}": (3, 24, 84)
        for camera in ("shouldercamera0", "shouldercamera1", "robot0_eye_in_hand", "robot1_eye_in_hand")
    }
    assert OBS_ENV_STATE not in features


def test_choices_are_those_of_the_tables():
    assert get_args(Task) == tuple(TASKS)
    assert get_args(ObsType) == tuple(OBSERVED_KEYS)


def test_command_line_and_round_trip():
    argv = [
        "--env.type=robosuite_robomimic",
        "--env.task=tool_hang",
        "--env.cameras=[frontview]",
        "--env.obs_type=pixels",
    ]
    config = draccus.parse(Command, args=argv).env
    assert isinstance(config, RobomimicEnvConfig)
    assert (config.cameras, config.fps, config.episode_length) == (["frontview"], 20, 700)
    assert draccus.decode(EnvConfig, draccus.encode(config, EnvConfig)) == config
    assert pickle.loads(pickle.dumps(config)) == config


def test_defaults_are_robomimics():
    lift, transport = RobomimicEnvConfig(), RobomimicEnvConfig(task="transport")
    assert (lift.episode_length, lift.cameras) == (400, ["agentview", "robot0_eye_in_hand"])
    assert (transport.episode_length, len(transport.cameras)) == (700, 4)
    assert lift.features[AGENT_POS].shape == (9,)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "juggle"}, "--env.task must be one of lift, can"),
        ({"obs_type": "depth"}, "obs_type must be one of state, pixels_agent_pos, pixels; got 'depth'"),
        ({"cameras": ["shouldercamera0"]}, "shouldercamera0.*agentview.*for lift"),
        ({"cameras": []}, "at least one of"),
        ({"observation_width": 0}, "observation_width=0"),
        ({"fps": 30}, "fps=30.*20 steps per second"),
        ({"episode_length": 0}, "episode_length"),
        ({"render_mode": "human"}, "render_mode=human"),
    ],
)
def test_what_it_cannot_do_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RobomimicEnvConfig(**options)


def test_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "robosuite", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lerobot_policy_agpd\[robomimic\]'"):
        make_env(RobomimicEnvConfig(), n_envs=2)
