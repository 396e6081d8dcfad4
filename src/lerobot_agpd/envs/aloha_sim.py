"""gym_aloha's bimanual simulation with low-dimensional observations, and images only where they are asked for.

gym_aloha renders three cameras at every control step, whatever is observed. Here its tasks observe joints and object
poses alone; everything else (physics, rewards, starts) is gym_aloha's.
"""

from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np
from dm_control.mujoco import Physics
from dm_control.rl import control
from gym_aloha.env import AlohaEnv

from lerobot_agpd.envs.aloha import TASKS
from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, View
from lerobot_agpd.envs.rendering import ViewedEnv

ARM_DOF = 6
SIMULATIONS = {"AlohaTransferCube-v0": "transfer_cube", "AlohaInsertion-v0": "insertion"}
"""Task to gym_aloha's name of its simulation."""


class AlohaStateEnv(ViewedEnv, AlohaEnv):
    """`gym_aloha.env.AlohaEnv` that shows what `view` says.

    `agent_pos` (14,) holds the joint positions of the left and the right arm, radians, each followed by its gripper's
    opening in [0, 1]; `environment_state` one pose (7,) per object: position, meters, and quaternion, w first;
    `pixels` one image (height, width, 3) per camera.
    """

    def __init__(self, task: str, view: View) -> None:
        """Build the simulation of a task of `aloha.TASKS`."""
        super().__init__(SIMULATIONS[task], obs_type="")
        self.set_view(view, TASKS[task])
        self.action_space = self._joint_limits()

    def _joint_limits(self) -> gym.spaces.Box:
        """Actions are absolute joint positions; gym_aloha declares [-1, 1], which START_ARM_POSE leaves already."""
        limits = self._env.physics.model.actuator_ctrlrange  # (16, 2), two fingers per gripper
        left, right = limits[:ARM_DOF], limits[8 : 8 + ARM_DOF]
        low, high = np.concatenate([left, [[0.0, 1.0]], right, [[0.0, 1.0]]], dtype=np.float32).T
        return gym.spaces.Box(low, high, dtype=np.float32)

    def _make_env_task(self, task_name: str) -> control.Environment:
        env = super()._make_env_task(task_name)
        env.task.get_observation = self._read  # instead of three images
        return env

    def _read(self, physics: Physics) -> dict[str, np.ndarray]:
        task = self._env.task
        return {AGENT_POS: task.get_qpos(physics), ENVIRONMENT_STATE: task.get_env_state(physics)}

    def _format_raw_obs(self, raw_obs: dict[str, np.ndarray]) -> dict[str, Any]:
        return self.observe(raw_obs[AGENT_POS], raw_obs[ENVIRONMENT_STATE])

    def scene(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of the simulation."""
        return self._env.physics.model.ptr, self._env.physics.data.ptr

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset; without a seed, to a start that follows from the last seed (gym_aloha's would be arbitrary)."""
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        return cast(tuple[dict[str, Any], dict[str, Any]], super().reset(seed=seed, options=options))

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step of 20 ms; reward 0 to 4, success at 4."""
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, float(reward), bool(terminated), bool(truncated), {"is_success": bool(terminated)}
