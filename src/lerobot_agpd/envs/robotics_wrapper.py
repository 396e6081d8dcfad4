"""Wrapper that gives an environment of Gymnasium-Robotics LeRobot's raw keys, success and task description."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS, image_space, unbounded
from lerobot_agpd.envs.rendering import SceneRenderer
from lerobot_agpd.envs.robotics_tasks import OBSERVED_KEYS, RawObservation, get_task


@dataclass(frozen=True)
class View:
    """Type of the observation, and sizes of images, (height, width) in pixels."""

    obs_type: str = "state"
    observation_size: tuple[int, int] = (96, 96)
    visualization_size: tuple[int, int] = (480, 480)
    shadows: bool = True


def configured_camera(simulation: Any) -> mujoco.MjvCamera | int:
    """Camera that an environment of gymnasium renders with: number of one of the model's, or a free one.

    A free camera looks where gymnasium's viewer looks, but from the model's own pose: no episode moves it.

    Args:
        simulation: has `model` and `mujoco_renderer`.
    """
    stock = simulation.mujoco_renderer
    if stock.camera_id >= 0:
        return int(stock.camera_id)
    at_rest = mujoco.MjData(simulation.model)
    mujoco.mj_forward(simulation.model, at_rest)
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(simulation.model, camera)
    camera.lookat[:] = np.median(at_rest.geom_xpos, axis=0)
    camera.distance = simulation.model.stat.extent
    for name, value in (stock.default_cam_config or {}).items():
        setattr(camera, name, value)
    return camera


class RoboticsWrapper(gym.Wrapper, RecordConstructorArgs):
    """One task of `robotics_tasks.TASKS` with LeRobot's raw keys.

    Observations hold the keys that `view.obs_type` asks for (float32 vectors, uint8 images); `info["is_success"]` is a
    bool after every step and after a reset; `task` and `task_description` are attributes.
    """

    def __init__(self, env: gym.Env, task: str, view: View | None = None) -> None:
        """Wrap `env`.

        Args:
            env: environment made from the id `task`.
            task: its key in `TASKS`.
            view: what to observe; the state by default.

        Raises:
            ValueError: if the task is not known.
        """
        view = view or View()
        RecordConstructorArgs.__init__(self, task=task, view=view)
        super().__init__(env)
        self._spec_of_task = get_task(task)
        self._view = view
        self.task = task
        self.task_description = self._spec_of_task.description
        goal: Any = getattr(env.unwrapped, "goal", None)
        if isinstance(goal, dict):  # the kitchen, whose goal names the tasks
            self.task_description = f"Kitchen: {', '.join(goal)}."
        self._simulation: Any = getattr(
            env.unwrapped, "robot_env", env.unwrapped
        )  # the kitchen wraps its robot
        self._camera = configured_camera(self._simulation)
        self.scene_renderer = SceneRenderer(view.shadows)
        layout = self._spec_of_task.layout
        spaces: dict[str, gym.Space] = {
            AGENT_POS: unbounded(layout.agent_pos_dim),
            ENVIRONMENT_STATE: unbounded(layout.environment_state_dim),
            PIXELS: image_space(*view.observation_size),
        }
        self.observation_space = gym.spaces.Dict({key: spaces[key] for key in OBSERVED_KEYS[view.obs_type]})
        self.state: dict[str, np.ndarray] = {}
        """`agent_pos` and `environment_state` of the last observation, also where `view` shows images: for experts."""

    def _observe(self, raw: RawObservation) -> dict[str, np.ndarray]:
        self.state = self._spec_of_task.layout.split(raw)
        keys = OBSERVED_KEYS[self._view.obs_type]
        observation = {key: value for key, value in self.state.items() if key in keys}
        if PIXELS in keys:
            observation[PIXELS] = self._image(self._view.observation_size)
        return observation

    def _image(self, size: tuple[int, int]) -> np.ndarray:
        if hasattr(self._simulation, "_render_callback"):
            self._simulation._render_callback()  # Fetch: puts the target's marker in its place
        return self.scene_renderer.render(self._simulation.model, self._simulation.data, self._camera, size)

    def _with_success(self, raw: RawObservation, info: dict[str, Any]) -> dict[str, Any]:
        return {**info, "is_success": self._spec_of_task.success(self.env.unwrapped, raw, info)}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Reset; `info["is_success"]` says whether the goal holds already (Fetch only)."""
        raw, info = self.env.reset(seed=seed, options=options)
        return self._observe(raw), self._with_success(raw, info)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Step, with a float reward and a bool `info["is_success"]`."""
        raw, reward, terminated, truncated, info = self.env.step(action)
        info = self._with_success(raw, info)
        return self._observe(raw), float(reward), bool(terminated), bool(truncated), info

    def render(self) -> np.ndarray:
        """Render a frame of `view.visualization_size`."""
        return self._image(self._view.visualization_size)

    def close(self) -> None:
        """Close the renderers and the environment."""
        self.scene_renderer.close()
        super().close()
