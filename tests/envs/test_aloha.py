"""The environment type `aloha_state` against gym_aloha."""

import gymnasium as gym
import numpy as np
import pytest
from lerobot.envs import preprocess_observation
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import ACTION

from lerobot_agpd.envs.aloha import CAMERAS, AlohaStateEnvConfig
from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS

gym_aloha = pytest.importorskip("gym_aloha")
START = np.array([0, -0.96, 1.16, 0, -0.3, 0, 0.1] * 2, dtype=np.float32)
SMALL = {"observation_height": 24, "observation_width": 32, "shadows": False}


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
    assert set(CAMERAS) == {model.id2name(camera, "camera") for camera in range(model.ncam)}
