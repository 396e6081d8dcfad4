"""The environment: two coordinates, one goal."""

from typing import Any

import gymnasium as gym
import numpy as np

BOX = gym.spaces.Box(-2, 2, shape=(2,), dtype=np.float32)
REACHED = 0.3


class Point(gym.Env):
    """A point at the origin, moved by at most one unit per step; it succeeds within REACHED of the goal."""

    observation_space = gym.spaces.Dict({"agent_pos": BOX, "environment_state": BOX})
    action_space = gym.spaces.Box(-1, 1, shape=(2,), dtype=np.float32)
    task_description = "walk to the goal"

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, bool]]:
        """Start at the origin, the goal at a distance of one in a random direction."""
        super().reset(seed=seed)
        angle = self.np_random.uniform(0, 2 * np.pi)
        self.position = np.zeros(2, dtype=np.float32)
        self.goal = np.array([np.cos(angle), np.sin(angle)], dtype=np.float32)
        return self._observation(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, bool]]:
        """Move by a quarter of the action."""
        self.position = self.position + 0.25 * np.clip(action, -1, 1).astype(np.float32)
        distance = float(np.linalg.norm(self.goal - self.position))
        success = distance < REACHED
        return self._observation(), -distance, success, False, {"is_success": success}

    def _observation(self) -> dict[str, np.ndarray]:
        return {"agent_pos": self.position.copy(), "environment_state": self.goal.copy()}
