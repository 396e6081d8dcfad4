"""The environment type `aloha_state` against gym_aloha, and as LeRobot's own commands use it."""

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
from lerobot.envs import EnvConfig, make_env, preprocess_observation
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_agpd.envs.aloha import ALOHA_TASKS, OBSERVED_KEYS, AlohaStateEnvConfig, Camera, ObsType, Task
from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS

gym_aloha = pytest.importorskip("gym_aloha")
START = np.array([0, -0.96, 1.16, 0, -0.3, 0, 0.1] * 2, dtype=np.float32)
SMALL = {"observation_height": 24, "observation_width": 32, "shadows": False}


@dataclass
class Command:
    """Options of a command with an environment, such as `lerobot-eval`."""

    env: EnvConfig


@pytest.mark.parametrize("task", ALOHA_TASKS)
def test_gymnasium_env_checker_accepts_it(task):
    (env,) = make_env(AlohaStateEnvConfig(task=task))["aloha_state"][0].envs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # unbounded observations, and being wrapped at all
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize(("task", "n_objects"), [("AlohaTransferCube-v0", 1), ("AlohaInsertion-v0", 2)])
def test_observation_holds_joints_and_object_poses(task, n_objects):
    env = AlohaStateEnvConfig(task=task).make_single()
    observation, info = env.reset(seed=4)
    assert info["is_success"] is False
    assert observation[ENVIRONMENT_STATE].shape == (7 * n_objects,)
    qpos = env.unwrapped._env.physics.data.qpos
    np.testing.assert_allclose(observation[ENVIRONMENT_STATE], qpos[16:], rtol=1e-6)
    np.testing.assert_allclose(observation[AGENT_POS][:6], qpos[:6], atol=1e-6)
    np.testing.assert_allclose(observation[AGENT_POS][7:13], qpos[8:14], atol=1e-6)


def test_physics_is_gym_alohas(rendering):
    ours = AlohaStateEnvConfig().make_single()
    theirs = gym.make("gym_aloha/AlohaTransferCube-v0", obs_type="pixels_agent_pos")
    observation, _ = ours.reset(seed=7)
    reference, _ = theirs.reset(seed=7)
    for step in range(3):
        np.testing.assert_allclose(observation[AGENT_POS], reference["agent_pos"], atol=1e-6)
        action = START + np.float32(0.02 * step)
        observation, reward, *_ = ours.step(action)
        reference, expected, *_ = theirs.step(action)
        assert reward == expected
    ours.close()


def test_seed_determines_the_start_also_of_later_episodes():
    env = AlohaStateEnvConfig().make_single()
    starts = {}
    for seed in (1, 2, 1):
        first, _ = env.reset(seed=seed)
        second, _ = env.reset()
        pair = np.stack([first[ENVIRONMENT_STATE], second[ENVIRONMENT_STATE]])
        assert not np.array_equal(*pair)
        np.testing.assert_array_equal(starts.setdefault(seed, pair), pair)
    assert not np.array_equal(starts[1], starts[2])


def test_actions_reach_beyond_one_and_rest_is_within():
    space = AlohaStateEnvConfig().make_single().action_space
    assert space.contains(START)
    assert space.low[0] < -3 and space.high[0] > 3
    np.testing.assert_array_equal([space.low[[6, 13]], space.high[[6, 13]]], [[0, 0], [1, 1]])


def test_cube_between_the_left_fingers_in_the_air_is_a_success():
    env = AlohaStateEnvConfig().make_single()
    env.reset(seed=0)
    physics = env.unwrapped._env.physics
    env.step(START)
    finger = physics.named.data.geom_xpos["vx300s_left/10_left_gripper_finger"]
    physics.data.qpos[16:19] = finger
    physics.data.qvel[:] = 0
    _, reward, terminated, _, info = env.step(START)
    assert (reward, terminated, info["is_success"]) == (4.0, True, True)


@pytest.mark.parametrize("use_async_envs", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_vector_env_agrees_with_the_declared_features(use_async_envs):
    config = AlohaStateEnvConfig(episode_length=2)
    env = make_env(config, n_envs=2, use_async_envs=use_async_envs)["aloha_state"][0]
    try:
        assert env.call("_max_episode_steps") == (2, 2)
        assert env.call("task_description")[0].startswith("Pick up the cube")
        observation, _ = env.reset(seed=[5, 6])
        features = env_to_policy_features(config)
        batch = preprocess_observation(observation)
        assert set(batch) == {OBS_STATE, OBS_ENV_STATE} == set(features) - {ACTION}
        assert all(tuple(batch[key].shape[1:]) == features[key].shape for key in batch)
        env.step(np.stack([START, START]))
        _, _, _, truncated, info = env.step(np.stack([START, START]))
        assert truncated.all() and info["final_info"]["is_success"].tolist() == [False, False]
    finally:
        env.close()


def test_images_come_from_the_chosen_cameras_in_the_chosen_size(rendering):
    config = AlohaStateEnvConfig(obs_type="pixels_agent_pos", cameras=["top", "left_wrist"], **SMALL)
    env = config.make_single()
    observation, _ = env.reset(seed=0)
    assert list(observation[PIXELS]) == ["top", "left_wrist"]
    assert all(image.shape == (24, 32, 3) and image.std() > 5 for image in observation[PIXELS].values())
    batch = preprocess_observation(observation)
    features = env_to_policy_features(config)
    assert features["observation.images.left_wrist"].shape == (3, 24, 32)
    assert set(features) - {ACTION} == set(batch)
    env.close()


@pytest.mark.parametrize("obs_type", ["environment_state_agent_pos", "pixels"])
def test_the_state_is_at_hand_whatever_is_observed(rendering, obs_type):
    env = AlohaStateEnvConfig(obs_type=obs_type, **SMALL).make_single()
    env.reset(seed=3)
    env.step(START)
    state = env.get_wrapper_attr("state")
    qpos = env.unwrapped._env.physics.data.qpos
    np.testing.assert_allclose(state[ENVIRONMENT_STATE], qpos[16:], rtol=1e-6)
    np.testing.assert_allclose(state[AGENT_POS][:6], qpos[:6], atol=1e-6)
    assert env.get_wrapper_attr("task_description").startswith("Pick up the cube")
    env.close()


def test_the_cameras_are_the_models():
    model = AlohaStateEnvConfig().make_single().unwrapped._env.physics.model
    assert set(get_args(Camera)) == {model.id2name(camera, "camera") for camera in range(model.ncam)}


def test_choices_are_those_of_the_tables():
    assert get_args(Task) == tuple(ALOHA_TASKS)
    assert get_args(ObsType) == tuple(OBSERVED_KEYS)


def test_command_line_and_round_trip():
    argv = ["--env.type=aloha_state", "--env.task=AlohaInsertion-v0", "--env.cameras=[angle]"]
    config = draccus.parse(Command, args=argv).env
    assert isinstance(config, AlohaStateEnvConfig) and config.cameras == ["angle"]
    assert draccus.decode(EnvConfig, draccus.encode(config, EnvConfig)) == config
    assert pickle.loads(pickle.dumps(config)) == config


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "AlohaLaundry-v0"}, "AlohaLaundry-v0"),
        ({"obs_type": "state"}, "obs_type must be one of environment_state_agent_pos"),
        ({"cameras": ["behind"]}, "behind.*must name at least one of top"),
        ({"cameras": []}, "at least one of top"),
        ({"fps": 30}, "fps=30.*50 steps per second"),
        ({"render_mode": "human"}, "render_mode=human"),
        ({"episode_length": 0}, "episode_length"),
        ({"observation_height": 3}, "observation_height=3"),
    ],
)
def test_what_it_cannot_do_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        AlohaStateEnvConfig(**options)


def test_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_aloha", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lerobot_policy_agpd\[aloha\]'"):
        make_env(AlohaStateEnvConfig())
