"""The environment type `gymnasium_robotics`: seeds and images."""

import gymnasium as gym
import numpy as np
import pytest
from lerobot.envs import make_env, preprocess_observation
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.robotics_tasks import KITCHEN

pytest.importorskip("gymnasium_robotics")


def roll(env: gym.Env, seed: int, n_steps: int = 20) -> np.ndarray:
    """Observations (n_steps + 1, D) under random actions that depend on the seed only."""
    size = (n_steps, *env.action_space.shape)
    actions = np.random.default_rng(seed).uniform(-1, 1, size=size).astype(np.float32)
    observations = [env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)]
    return np.stack([np.concatenate([o[AGENT_POS], o[ENVIRONMENT_STATE]]) for o in observations])


@pytest.mark.slow
def test_vector_env_of_pixels_agrees_with_the_declared_features(rendering):
    config = GymnasiumRoboticsEnv(
        task="FetchReach-v4", obs_type="pixels_agent_pos", observation_height=48, observation_width=64
    )
    env = make_env(config, n_envs=2, use_async_envs=True)["gymnasium_robotics"][0]
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
    first, other, again = (roll(used, seed) for seed in (1, 2, 1))
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, roll(config.make_single(), seed=1))
    assert not np.array_equal(first, other)
