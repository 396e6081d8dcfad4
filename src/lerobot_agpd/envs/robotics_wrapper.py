"""Wrapper that gives an environment of Gymnasium-Robotics LeRobot's raw keys, success and task description."""

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from lerobot_agpd.envs.base import View
from lerobot_agpd.envs.rendering import Camera, ViewedEnv
from lerobot_agpd.envs.robotics_tasks import RawObservation, RoboticsTask


def configured_camera(simulation: Any) -> Camera:
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


class RoboticsWrapper(ViewedEnv, gym.Wrapper, gym.utils.RecordConstructorArgs):
    """One task of Gymnasium-Robotics, or of ours on its robots, with LeRobot's raw keys.

    `info["is_success"]` is a bool after every step and after a reset; `task` and `task_description` are attributes.
    """

    def __init__(self, env: gym.Env, task: str, spec: RoboticsTask, view: View) -> None:
        """Wrap the environment of the task named `task`."""
        gym.utils.RecordConstructorArgs.__init__(self, task=task, spec=spec, view=view)
        gym.Wrapper.__init__(self, env)
        self.task, self.spec_of_task = task, spec
        self.set_view(view, self.spec_of_task)
        goal: Any = getattr(env.unwrapped, "goal", None)
        if isinstance(goal, dict):  # the kitchen, whose goal names the tasks
            self.task_description = f"Kitchen: {', '.join(goal)}."
        self._simulation: Any = getattr(env.unwrapped, "robot_env", env.unwrapped)  # the kitchen's robot
        self._shown: mujoco.MjData | None = None  # a copy of the simulation's data, as it is drawn
        if view.main_pose is None:
            self.main_camera = configured_camera(self._simulation)

    def scene(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of the simulation, or of a copy."""
        simulation = self._simulation
        if not hasattr(simulation, "_render_callback"):
            return simulation.model, simulation.data
        # Fetch puts the target's marker in its place with mj_forward, from which the next step's solver would start
        # elsewhere: an episode would depend on whether it is looked at.
        if self._shown is None:
            self._shown = mujoco.MjData(simulation.model)
        mujoco.mj_copyData(self._shown, simulation.model, simulation.data)
        mujoco.mj_kinematics(simulation.model, self._shown)  # the callback reads where the marker is
        data, simulation.data = simulation.data, self._shown
        try:
            simulation._render_callback()
        finally:
            simulation.data = data
        return simulation.model, self._shown

    def _with_success(self, raw: RawObservation, info: dict[str, Any]) -> dict[str, Any]:
        return {**info, "is_success": self.spec_of_task.success(self.env.unwrapped, raw, info)}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Reset; `info["is_success"]` says whether the goal holds already (Fetch only)."""
        raw, info = self.env.reset(seed=seed, options=options)
        return self.observe(*self.spec_of_task.split(raw)), self._with_success(raw, info)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Step, with a float reward and a bool `info["is_success"]`."""
        raw, reward, terminated, truncated, info = self.env.step(action)
        observation, info = self.observe(*self.spec_of_task.split(raw)), self._with_success(raw, info)
        return observation, float(reward), bool(terminated), bool(truncated), info
