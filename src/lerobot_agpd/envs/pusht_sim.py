"""gym_pusht's simulation that shows what a view says; physics, rewards and starts are gym_pusht's."""

from typing import Any

import gymnasium as gym
import numpy as np
from gym_pusht.envs.pusht import PushTEnv

from lerobot_agpd.envs.base import AGENT_POS, DESCRIPTIONS, ENVIRONMENT_STATE, PIXELS, View

TABLE = 512.0
"""Edge of the table, pixels of the simulation."""


class PushTStateEnv(PushTEnv):
    """`gym_pusht.envs.pusht.PushTEnv` with `agent_pos` (2,), the block's corners (16,) and an image side by side."""

    def __init__(self, view: View) -> None:
        """Build the simulation."""
        (height, width), (frame_height, frame_width) = view.observation_size, view.visualization_size
        super().__init__(
            obs_type="pixels_agent_pos",
            render_mode="rgb_array",
            observation_width=width,
            observation_height=height,
            visualization_width=frame_width,
            visualization_height=frame_height,
        )
        self.task, self.task_description = "PushT-v0", DESCRIPTIONS["gym_pusht/PushT-v0"]
        self.view = view
        spaces: dict[str, gym.Space] = {
            AGENT_POS: gym.spaces.Box(0.0, TABLE, (2,), np.float32),
            # The block may be pushed over the table's edge.
            ENVIRONMENT_STATE: gym.spaces.Box(-np.inf, np.inf, (16,), np.float32),
            PIXELS: gym.spaces.Box(0, 255, (height, width, 3), np.uint8),
        }
        self.observation_space = gym.spaces.Dict({key: spaces[key] for key in view.keys})

    def get_obs(self) -> dict[str, Any]:
        """Return the raw observation; nothing is drawn unless it is observed."""
        readings = {
            AGENT_POS: lambda: np.array(self.agent.position, dtype=np.float32),
            ENVIRONMENT_STATE: lambda: self.get_keypoints(self._block_shapes).flatten().astype(np.float32),
            PIXELS: self._render,
        }
        return {key: readings[key]() for key in self.view.keys}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step of 0.1 s; reward as gym_pusht's, success ends the episode."""
        observation, reward, terminated, truncated, info = super().step(action)
        info["is_success"] = bool(info["is_success"])
        return observation, float(reward), bool(terminated), truncated, info
