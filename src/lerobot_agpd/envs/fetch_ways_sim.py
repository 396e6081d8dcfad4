"""The simulation of `fetch_ways`: Fetch of Gymnasium-Robotics with several blocks and marked places."""

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
START_NOISE = 0.015  # meters in x and y, at most: of every block, or without one of the robot
BASE = {"robot0:slide0": 0.405, "robot0:slide1": 0.48, "robot0:slide2": 0.0}  # Fetch's place at the table
OPEN_FINGERS = {"robot0:l_gripper_finger_joint": 0.05, "robot0:r_gripper_finger_joint": 0.05}
HALF_BLOCK = 0.025  # meters, Fetch's


def write_model(task: FetchWaysTask, folder: Path) -> Path:
    """Write Fetch's model with the blocks and places of a task, and return its path."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / "fetch" / f"{task.model}.xml"))
    spec.meshdir, spec.texturedir = str(ASSETS / "stls" / "fetch"), str(ASSETS / "textures")
    spec.site("target0").rgba = np.zeros(4)  # the stock target
    for i, place in enumerate(task.places):
        spec.worldbody.add_site(
            name=f"place_{i}", pos=place, size=[PLACE_RADIUS, 0.0, 0.0], rgba=[1.0, 0.0, 0.0, 0.3]
        )
    for i in range(1, len(task.blocks)):  # like the first, which Fetch's model has
        body = spec.worldbody.add_body(name=f"object{i}", pos=task.blocks[i])
        body.add_joint(name=f"object{i}:joint", type=mujoco.mjtJoint.mjJNT_FREE, damping=[0.01, 0.0, 0.0])
        body.add_geom(
            name=f"object{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[HALF_BLOCK] * 3,
            condim=3,
            material="block_mat",
            mass=2.0,
        )
    spec.compile()
    path = folder / "fetch.xml"
    path.write_text(spec.to_xml())
    return path


class FetchWays(MujocoFetchEnv):
    """One task of `fetch_ways_tasks.TASKS` as a goal environment.

    The achieved goal holds the positions of all blocks, or without one that of the gripper, and the desired goal all
    places. Any block at any place ends the episode with reward 1 and `info["is_success"]`.
    """

    def __init__(self, task: FetchWaysTask) -> None:
        """Build the simulation; no graphics context is opened before the first image."""
        self.task = task
        starts = {f"object{i}:joint": [*start, 1.0, 0.0, 0.0, 0.0] for i, start in enumerate(task.blocks)}
        fingers = OPEN_FINGERS if task.model == "pick_and_place" else {}
        with tempfile.TemporaryDirectory() as folder:
            super().__init__(
                model_path=str(write_model(task, Path(folder))),
                has_object=bool(task.blocks),
                block_gripper=task.model != "pick_and_place",
                n_substeps=20,
                gripper_extra_height=task.hand_height,
                target_in_the_air=True,
                target_offset=0.0,
                obj_range=0.0,
                target_range=0.0,
                distance_threshold=PLACE_RADIUS,
                initial_qpos={**BASE, **fingers, **starts},
                reward_type="sparse",
            )

    def _reset_sim(self) -> bool:
        """Put everything where it starts, the blocks or without one the robot moved by a little noise."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.time = self.initial_time
        self.data.qpos[:], self.data.qvel[:] = self.initial_qpos, self.initial_qvel
        noise = self.np_random.uniform(-START_NOISE, START_NOISE, size=(max(len(self.task.blocks), 1), 2))
        if self.task.blocks:
            for i, start in enumerate(self.task.blocks):
                first = self.model.joint(f"object{i}:joint").qposadr[0]
                self.data.qpos[first : first + 2] = start[:2] + noise[i]
        else:
            base = [self.model.joint(name).qposadr[0] for name in ("robot0:slide0", "robot0:slide1")]
            self.data.qpos[base] += noise[0]
        mujoco.mj_forward(self.model, self.data)
        return True

    def _get_obs(self) -> dict[str, Array]:
        observation: dict[str, Array] = super()._get_obs()
        if self.task.blocks:
            blocks = [self.data.body(f"object{i}").xpos for i in range(len(self.task.blocks))]
            observation["achieved_goal"] = np.concatenate(blocks)
        return observation

    def _sample_goal(self) -> Array:
        return np.array(self.task.places).ravel()

    def _is_success(self, achieved_goal: Array, desired_goal: Array) -> bool:
        brought, places = achieved_goal.reshape(-1, 1, 3), desired_goal.reshape(1, -1, 3)
        return bool(np.linalg.norm(brought - places, axis=-1).min() < PLACE_RADIUS)

    def compute_reward(self, achieved_goal: Array, goal: Array, info: dict[str, Any]) -> float:
        """1 at a place and 0 elsewhere."""
        return float(self._is_success(achieved_goal, goal))

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: dict[str, Any]) -> bool:
        """Whether a place is reached."""
        return self._is_success(achieved_goal, desired_goal)

    def _render_callback(self) -> None:
        """Nothing: the marks of the places do not move."""
