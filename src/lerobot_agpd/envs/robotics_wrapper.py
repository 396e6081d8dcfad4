"""Presents an environment of Gymnasium-Robotics the way LeRobot expects it: state or pixels, success, description."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS, image_space, unbounded
from lerobot_agpd.envs.robotics_tasks import OBSERVED_KEYS, RawObservation, get_task_spec


@dataclass(frozen=True)
class View:
    """What is observed, and what its images look like; sizes are (height, width) in pixels."""

    obs_type: str = "state"
    observation_size: tuple[int, int] = (96, 96)
    visualization_size: tuple[int, int] = (480, 480)
    shadows: bool = True


class SceneRenderer:
    """Images of a simulation at several sizes, from the camera that its environment renders with.

    A graphics context is opened at the first image of a size. Each is made current before use, so that several
    environments in one process do not draw into each other's; gymnasium's own renderer leaves that out.
    """

    def __init__(self, simulation: Any, sizes: tuple[tuple[int, int], ...], shadows: bool = True) -> None:
        """Look at a simulation.

        Args:
            simulation: has `model`, `data` and `mujoco_renderer`.
            sizes: (height, width) of every kind of image that will be asked for.
            shadows: whether to draw them; without a GPU they take most of the time.
        """
        self._simulation = simulation
        self._shadows = shadows
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}
        buffer = simulation.model.vis.global_
        buffer.offheight = max(buffer.offheight, *(height for height, _ in sizes))
        buffer.offwidth = max(buffer.offwidth, *(width for _, width in sizes))
        self._camera = self._configured_camera()

    def _configured_camera(self) -> mujoco.MjvCamera | int:
        stock = self._simulation.mujoco_renderer
        if stock.camera_id >= 0:
            return int(stock.camera_id)
        # Where gymnasium's viewer looks, too, but from the model's own pose: no episode moves the camera.
        model = self._simulation.model
        at_rest = mujoco.MjData(model)
        mujoco.mj_forward(model, at_rest)
        camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, camera)
        camera.lookat[:] = np.median(at_rest.geom_xpos, axis=0)
        camera.distance = model.stat.extent
        for name, value in (stock.default_cam_config or {}).items():
            setattr(camera, name, value)
        return camera

    @property
    def is_open(self) -> bool:
        """Whether an image has been rendered."""
        return bool(self._renderers)

    def render(self, size: tuple[int, int]) -> np.ndarray:
        """Render the current state.

        Args:
            size: height and width, pixels.

        Returns:
            (height, width, 3) uint8.
        """
        if size not in self._renderers:
            self._renderers[size] = mujoco.Renderer(self._simulation.model, *size)
            self._renderers[size].scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._shadows
        if hasattr(self._simulation, "_render_callback"):
            self._simulation._render_callback()  # Fetch: puts the target's marker in its place
        self._renderers[size].update_scene(self._simulation.data, self._camera)
        return self._renderers[size].render()

    def close(self) -> None:
        """Free the graphics contexts."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()


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
        self._spec_of_task = get_task_spec(task)
        self._view = view
        self.task = task
        self.task_description = self._spec_of_task.description
        goal: Any = getattr(env.unwrapped, "goal", None)
        if isinstance(goal, dict):  # the kitchen, whose goal names the tasks
            self.task_description = f"Kitchen: {', '.join(goal)}."
        simulation = getattr(env.unwrapped, "robot_env", env.unwrapped)  # the kitchen wraps its robot
        sizes = (view.observation_size, view.visualization_size)
        self.scene_renderer = SceneRenderer(simulation, sizes, view.shadows)
        layout = self._spec_of_task.layout
        spaces: dict[str, gym.Space] = {
            AGENT_POS: unbounded(layout.agent_pos_dim),
            ENVIRONMENT_STATE: unbounded(layout.environment_state_dim),
            PIXELS: image_space(*view.observation_size),
        }
        self.observation_space = gym.spaces.Dict({key: spaces[key] for key in OBSERVED_KEYS[view.obs_type]})
        self.state: dict[str, np.ndarray] = {}
        """`agent_pos` and `environment_state` of the last observation, whatever `view` shows: for scripted experts."""

    def _observe(self, raw: RawObservation) -> dict[str, np.ndarray]:
        self.state = self._spec_of_task.layout.split(raw)
        keys = OBSERVED_KEYS[self._view.obs_type]
        observation = {key: value for key, value in self.state.items() if key in keys}
        if PIXELS in keys:
            observation[PIXELS] = self.scene_renderer.render(self._view.observation_size)
        return observation

    def _with_success(self, raw: RawObservation, info: dict[str, Any]) -> dict[str, Any]:
        return {**info, "is_success": self._spec_of_task.success(self.env.unwrapped, raw, info)}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Reset, and tell in `info["is_success"]` whether the goal holds already (Fetch only)."""
        raw, info = self.env.reset(seed=seed, options=options)
        return self._observe(raw), self._with_success(raw, info)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Step, with a float reward and a bool `info["is_success"]`."""
        raw, reward, terminated, truncated, info = self.env.step(action)
        info = self._with_success(raw, info)
        return self._observe(raw), float(reward), bool(terminated), bool(truncated), info

    def render(self) -> Any:
        """Render a frame of `view.visualization_size` in mode `rgb_array`; other modes are the environment's."""
        if self.render_mode != "rgb_array":
            return super().render()
        return self.scene_renderer.render(self._view.visualization_size)

    def close(self) -> None:
        """Close the renderers and the environment."""
        self.scene_renderer.close()
        super().close()
