"""The simulation of `point_maze_ways`: PointMaze's ball and walls, with exits of which any is the goal."""

import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium_robotics.envs.maze.maze_v4 import Maze
from gymnasium_robotics.envs.maze.point import PointEnv

from lerobot_agpd.envs.base import View
from lerobot_agpd.envs.maze_tasks import FPS, TASKS, WALL, MazeTask
from lerobot_agpd.envs.rendering import ViewedEnv

WALL_HEIGHT = 0.4  # meters, PointMaze's
GOAL_RADIUS = 0.45  # meters, PointMaze's
START_NOISE = 0.15  # meters in x and y, at most
FRAME_SKIP = 10
assert FRAME_SKIP * FPS == 100  # PointMaze's steps per second


def build_point(task: MazeTask) -> PointEnv:
    """Build PointMaze's ball between the walls of a task, every exit marked."""
    cells: list[list[int | str]] = [[1 if cell == WALL else 0 for cell in row] for row in task.maze]
    ball = Path(mujoco_assets()) / "point.xml"
    _, written = Maze.make_maze(str(ball), cells, maze_size_scaling=1, maze_height=WALL_HEIGHT)
    tree = ET.parse(written)  # noqa: S314  # gymnasium-robotics has just written it
    Path(written).unlink()
    world = tree.find(".//worldbody")
    assert world is not None
    world.remove(next(site for site in world.findall("site") if site.get("name") == "target"))
    for i, (x, y) in enumerate(task.exits):
        ET.SubElement(
            world, "site", name=f"exit_{i}", pos=f"{x} {y} 0", size=f"{GOAL_RADIUS}", rgba="1 0 0 0.4"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "maze.xml"
        tree.write(path)
        point = PointEnv(xml_file=str(path))
    point.frame_skip = FRAME_SKIP
    return point


def mujoco_assets() -> str:
    """Folder of PointMaze's model."""
    import gymnasium_robotics

    return str(Path(gymnasium_robotics.__file__).parent / "envs" / "assets" / "point")


class PointMazeWays(ViewedEnv):
    """One task of `maze_tasks.TASKS` with LeRobot's raw keys.

    `agent_pos` (4,) is the ball's position and velocity, `environment_state` the vectors from the ball to all exits.
    An action is a force in PointMaze's units. Reaching any exit ends the episode with `info["is_success"]`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}
    render_mode = "rgb_array"
    action_names = ("force x", "force y")

    def __init__(self, task: str, view: View) -> None:
        """Build the simulation of a key of `maze_tasks.TASKS`; no graphics context is opened before the first image."""
        self.task, self.spec_of_task = task, TASKS[task]
        self.set_view(view, self.spec_of_task)
        self.point = build_point(self.spec_of_task)
        self.main_camera = self._camera_from_above()
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.spec_of_task.action_dim,), dtype=np.float32)

    def _camera_from_above(self) -> mujoco.MjvCamera:
        camera = mujoco.MjvCamera()
        camera.elevation, camera.azimuth = -90, 90
        camera.distance = 1.25 * max(len(self.spec_of_task.maze), len(self.spec_of_task.maze[0]))
        return camera

    def scene(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of the simulation."""
        return self.point.model, self.point.data

    def _observe(self) -> dict[str, Any]:
        position, velocity = self.point.data.qpos, self.point.data.qvel
        return self.observe(
            np.concatenate([position, velocity]), (self.spec_of_task.exits - position).ravel()
        )

    @property
    def is_success(self) -> bool:
        """Whether the ball is at an exit."""
        distances = np.linalg.norm(self.spec_of_task.exits - self.point.data.qpos, axis=1)
        return bool(distances.min() <= GOAL_RADIUS)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Put the ball at rest near the start, where the seed says, or without one the last seed."""
        super().reset(seed=seed)
        noise = self.np_random.uniform(-START_NOISE, START_NOISE, size=2)
        self.point.init_qpos[:] = self.spec_of_task.start + noise
        self.point.reset()
        return self._observe(), {"is_success": self.is_success}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """One control step of 0.1 s; the reward is 1 at an exit and 0 elsewhere."""
        self.point.step(np.asarray(action, dtype=np.float64))
        success = self.is_success
        return self._observe(), float(success), success, False, {"is_success": success}

    def close(self) -> None:
        """Free the graphics contexts and the simulation."""
        super().close()
        self.point.close()
