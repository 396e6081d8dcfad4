"""gym_aloha's bimanual simulation with low-dimensional observations, and images only where they are asked for.

gym_aloha renders three cameras at every control step, whatever is observed. The task classes here observe joints and
object poses alone; everything else (physics, rewards, starts) is gym_aloha's.
"""

from typing import Any, cast

import gymnasium as gym
import numpy as np
from dm_control import mujoco
from dm_control.rl import control
from gym_aloha.constants import ASSETS_DIR, DT
from gym_aloha.env import AlohaEnv
from gym_aloha.tasks.sim import BimanualViperXTask, InsertionTask, TransferCubeTask

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS, image_space, unbounded

ARM_DOF = 6
GRIPPERS = (6, 13)  # their places among the 14 joints; 0 is closed, 1 open


class _WithoutImages(BimanualViperXTask):
    """Observes joint positions and the objects' poses."""

    def get_observation(self, physics: mujoco.Physics) -> dict[str, np.ndarray]:
        return {AGENT_POS: self.get_qpos(physics), ENVIRONMENT_STATE: self.get_env_state(physics)}


class _TransferCube(_WithoutImages, TransferCubeTask):
    pass


class _Insertion(_WithoutImages, InsertionTask):
    pass


SIMULATIONS: dict[str, tuple[str, type[_WithoutImages]]] = {
    "transfer_cube": ("bimanual_viperx_transfer_cube.xml", _TransferCube),
    "insertion": ("bimanual_viperx_insertion.xml", _Insertion),
}


class AlohaStateEnv(AlohaEnv):
    """`gym_aloha.env.AlohaEnv` that observes the keys it is told to.

    `agent_pos` (14,) holds the joint positions of the left and the right arm, radians, each followed by its gripper's
    opening in [0, 1]; `environment_state` one pose (7,) per object: position, meters, and quaternion, w first;
    `pixels` one image (height, width, 3) per camera.
    """

    def __init__(
        self,
        task: str,
        keys: tuple[str, ...] = (AGENT_POS, ENVIRONMENT_STATE),
        cameras: tuple[str, ...] = ("top",),
        shadows: bool = True,
        **kwargs: Any,
    ) -> None:
        """Build the simulation.

        Args:
            task: `transfer_cube` or `insertion`.
            keys: raw keys to observe.
            cameras: names of the model's cameras, for `pixels`.
            shadows: whether images show them; without a GPU they take most of the time.
            kwargs: gym_aloha's own (image sizes, render mode).
        """
        super().__init__(task, obs_type="+".join(keys), **kwargs)
        self.state: dict[str, np.ndarray] = {}
        """`agent_pos` and `environment_state` of the last observation, whatever `keys` are: for scripted experts."""
        self.keys = keys
        self.cameras = cameras
        self.shadows = shadows
        image = image_space(self.observation_height, self.observation_width)
        spaces: dict[str, gym.Space] = {
            AGENT_POS: unbounded(14),
            ENVIRONMENT_STATE: unbounded(len(self._physics.data.qpos) - 16),
            PIXELS: gym.spaces.Dict(dict.fromkeys(cameras, image)),
        }
        self.observation_space = gym.spaces.Dict({key: spaces[key] for key in keys})
        self.action_space = self._joint_limits()

    @property
    def _physics(self) -> mujoco.Physics:
        return self._env.physics

    def _joint_limits(self) -> gym.spaces.Box:
        """Actions are absolute joint positions; gym_aloha declares [-1, 1], which START_ARM_POSE leaves already."""
        limits = self._physics.model.actuator_ctrlrange.astype(np.float32)  # (16, 2), two fingers per gripper
        left, right = limits[:ARM_DOF], limits[8 : 8 + ARM_DOF]
        gripper = np.array([[0.0, 1.0]], dtype=np.float32)
        low, high = np.concatenate([left, gripper, right, gripper]).T
        return gym.spaces.Box(low, high, dtype=np.float32)

    def _make_env_task(self, task_name: str) -> control.Environment:
        model, task_class = SIMULATIONS[task_name]
        physics = mujoco.Physics.from_xml_path(str(ASSETS_DIR / model))
        return control.Environment(physics, task_class(), time_limit=float("inf"), control_timestep=DT)

    def _format_raw_obs(self, raw_obs: dict[str, np.ndarray]) -> dict[str, Any]:
        self.state = {key: raw_obs[key].astype(np.float32) for key in (AGENT_POS, ENVIRONMENT_STATE)}
        observation: dict[str, Any] = {key: self.state[key] for key in self.keys if key != PIXELS}
        if PIXELS in self.keys:
            size = (self.observation_height, self.observation_width)
            observation[PIXELS] = {camera: self._image(camera, size) for camera in self.cameras}
        return observation

    def _image(self, camera: str, size: tuple[int, int]) -> np.ndarray:
        overrides = {} if self.shadows else {"shadow": False}
        image = self._physics.render(*size, camera_id=camera, render_flag_overrides=overrides)
        return np.ascontiguousarray(image)  # dm_control's is a flipped view

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

    def render(self) -> np.ndarray:
        """Frame (visualization_height, visualization_width, 3) of the top camera."""
        return self._image("top", (self.visualization_height, self.visualization_width))

    def close(self) -> None:
        """Free the graphics contexts."""
        self._physics.free()
