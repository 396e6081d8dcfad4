"""A third-party LeRobot plugin, as small as one can be: an environment type and the Gymnasium environment behind it."""

import gymnasium as gym

from lerobot_env_point.config import PointEnv

__all__ = ["PointEnv"]

gym.register("lerobot_env_point/Point-v0", entry_point="lerobot_env_point.env:Point", max_episode_steps=12)
