"""The simulation of `fetch_ways`: Fetch of Gymnasium-Robotics with marked places of which any is the goal, and walls."""

import tempfile
from pathlib import Path
from typing import Any

import gymnasium_robotics
import mujoco
import numpy as np
from gymnasium_robotics.envs.fetch.fetch_env import MujocoFetchEnv

from lerobot_agpd.envs.fetch_ways_tasks import PLACE_RADIUS, FetchWaysTask
from lerobot_agpd.envs.ways import Array

ASSETS = Path(gymnasium_robotics.__file__).parent / "envs" / "assets"
START_NOISE = 0.015  # meters in x and y, at most: of the block, or without one of the robot
BASE = {
    "robot0:slide0": 0.405,
    "robot0:slide1": 0.48,
    "robot0:slide2": 0.0,
}  # Fetch's place in front of the table

HAND_HEIGHTS = {"reach": 0.2, "push": 0.0, "pick_and_place": 0.2}  # Fetch's `gripper_extra_height`


def write_model(task: FetchWaysTask, folder: Path) -> Path:
    """Write Fetch's model with the places and walls of a task, and return its path."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / "fetch" / f"{task.model}.xml"))
    spec.meshdir, spec.texturedir = str(ASSETS / "stls" / "fetch"), str(ASSETS / "textures")
    spec.site("target0").rgba = np.zeros(4)  # the stock target
    for i, place in enumerate(task.places):
        spec.worldbody.add_site(
            name=f"place_{i}", pos=place, size=[PLACE_RADIUS, 0.0, 0.0], rgba=[1.0, 0.0, 0.0, 0.4]
        )
    for i, wall in enumerate(task.walls):
        spec.worldbody.add_geom(
            name=f"wall_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=wall.center,
            size=wall.half_size,
            rgba=[0.55, 0.4, 0.25, 1.0],
        )
    spec.compile()
    path = folder / "fetch.xml"
    path.write_text(spec.to_xml())
    return path


class FetchWays(MujocoFetchEnv):
    """One task of `fetch_ways_tasks.TASKS` as a goal environment: the goal is the list of all places.

    Reaching any of them ends the episode with reward 1 and `info["is_success"]`.
    """

    def __init__(self, task: FetchWaysTask) -> None:
        """Build the simulation; no graphics context is opened before the first image."""
        self.task = task
        start = {} if task.block is None else {"object0:joint": [*task.block, 1.0, 0.0, 0.0, 0.0]}
        with tempfile.TemporaryDirectory() as folder:
            super().__init__(
                model_path=str(write_model(task, Path(folder))),
                has_object=task.block is not None,
                block_gripper=task.model != "pick_and_place",
                n_substeps=20,
                gripper_extra_height=HAND_HEIGHTS[task.model],
                target_in_the_air=True,
                target_offset=0.0,
                obj_range=0.0,
                target_range=0.0,
                distance_threshold=PLACE_RADIUS,
                initial_qpos={**BASE, **start},
                reward_type="sparse",
            )

    def _reset_sim(self) -> bool:
        """Put everything where it starts, the block or the robot moved by a little noise."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.time = self.initial_time
        self.data.qpos[:], self.data.qvel[:] = self.initial_qpos, self.initial_qvel
        noise = self.np_random.uniform(-START_NOISE, START_NOISE, size=2)
        if self.task.block is None:
            joints = [self.model.joint(name).qposadr[0] for name in ("robot0:slide0", "robot0:slide1")]
            self.data.qpos[joints] += noise
        else:
            first = self.model.joint("object0:joint").qposadr[0]
            self.data.qpos[first : first + 2] = self.task.block[:2] + noise
        mujoco.mj_forward(self.model, self.data)
        return True

    def _sample_goal(self) -> Array:
        return np.array(self.task.places).ravel()

    def _is_success(self, achieved_goal: Array, desired_goal: Array) -> bool:
        distances = np.linalg.norm(desired_goal.reshape(-1, 3) - achieved_goal, axis=1)
        return bool(distances.min() < PLACE_RADIUS)

    def compute_reward(self, achieved_goal: Array, goal: Array, info: dict[str, Any]) -> float:
        """1 at a place and 0 elsewhere."""
        return float(self._is_success(achieved_goal, goal))

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: dict[str, Any]) -> bool:
        """Whether a place is reached."""
        return self._is_success(achieved_goal, desired_goal)

    def _render_callback(self) -> None:
        """Nothing: the marks of the places do not move."""
