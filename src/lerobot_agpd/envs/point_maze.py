"""LeRobot environment type `point_maze_ways`: PointMaze of Gymnasium-Robotics with maps that allow several ways.

The tasks are in `maze_tasks`, the simulation in `point_maze_sim`.
"""

from dataclasses import dataclass

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_agpd.envs.base import SimulatedEnvConfig
from lerobot_agpd.envs.maze_tasks import TASKS
from lerobot_agpd.envs.packages import require_packages


@EnvConfig.register_subclass("point_maze_ways")
@dataclass
class PointMazeWaysEnv(SimulatedEnvConfig):
    """Mazes with several ways to a goal, seen through the ball's state or from above."""

    tasks = TASKS

    # Maze: TwoWays-v0, ThreeExits-v0 or Chain-v0.
    task: str | None = "ThreeExits-v0"

    def make_single(self) -> gym.Env:
        """Build one environment; see `SimulatedEnvConfig.make_single`."""
        require_packages(["gymnasium_robotics", "mujoco"], "--env.type=point_maze_ways", extra="fetch")
        from lerobot_agpd.envs.point_maze_sim import PointMazeWays

        assert self.episode_length is not None  # filled in by __post_init__
        return gym.wrappers.TimeLimit(PointMazeWays(str(self.task), self.view), self.episode_length)
