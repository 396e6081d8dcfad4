"""LeRobot environment type `point_maze_ways`: PointMaze of Gymnasium-Robotics with maps that allow several ways.

The tasks are in `ways`, the simulation in `point_maze_sim`.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import gymnasium as gym
from lerobot.configs import PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import OBS_IMAGE

from lerobot_agpd.envs.base import PIXELS, RenderMode, SingleEnvConfig, require_packages
from lerobot_agpd.envs.robotics_tasks import OBSERVED_KEYS
from lerobot_agpd.envs.ways import ACTION_DIM, AGENT_POS_DIM, FPS, get_task

Task = Literal["TwoWays-v0", "ThreeExits-v0", "Chain-v0"]
ObsType = Literal["state", "pixels", "pixels_agent_pos"]


def make_single_env(task: str, episode_length: int, view_kwargs: dict[str, Any], render_mode: str) -> gym.Env:
    """Build one environment; a worker process that has imported nothing yet can call it.

    Args:
        task: key of `ways.TASKS`.
        episode_length: steps after which an episode is truncated.
        view_kwargs: for `point_maze_sim.View`.
        render_mode: gymnasium's.

    Raises:
        ModuleNotFoundError: if Gymnasium-Robotics is not installed.
    """
    require_packages(["gymnasium_robotics", "mujoco"], "--env.type=point_maze_ways", extra="fetch")
    from lerobot_agpd.envs.point_maze_sim import PointMazeWays, View

    env = PointMazeWays(task, View(**view_kwargs), render_mode)
    return gym.wrappers.TimeLimit(env, episode_length)


@EnvConfig.register_subclass("point_maze_ways")
@dataclass
class PointMazeWaysEnv(SingleEnvConfig, EnvConfig):
    """Mazes with several ways to a goal, seen through the ball's state or from above."""

    # Maze.
    task: Task | None = "ThreeExits-v0"
    # Control steps per second; there are 10 only.
    fps: int = FPS
    # Steps after which an episode is truncated; default: the task's own limit.
    episode_length: int | None = None
    # What is observed.
    obs_type: ObsType = "state"
    # Width of observed images, pixels.
    observation_width: int = 96
    # Height of observed images, pixels.
    observation_height: int = 96
    # gymnasium's render mode; nothing is rendered before `render` is called.
    render_mode: RenderMode = "rgb_array"
    # Width of rendered frames, pixels.
    visualization_width: int = 480
    # Height of rendered frames, pixels.
    visualization_height: int = 480
    # Derived from the task.
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    # Raw key to LeRobot key, derived from the task.
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Fill in what depends on the task and derive the features.

        Raises:
            ValueError: if an option is unknown or does not fit the task.
        """
        task = get_task(self.task)
        self.check_options(OBSERVED_KEYS, FPS, task.episode_length)
        self.set_features(
            OBSERVED_KEYS[self.obs_type],
            ACTION_DIM,
            AGENT_POS_DIM,
            task.environment_state_dim,
            {PIXELS: OBS_IMAGE},
        )

    @property
    def package_name(self) -> str:
        """Package that holds the simulation."""
        return "gymnasium_robotics"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keyword arguments for `point_maze_sim.View`."""
        return {
            "obs_type": self.obs_type,
            "observation_size": (self.observation_height, self.observation_width),
            "visualization_size": (self.visualization_height, self.visualization_width),
        }

    @property
    def factory(self) -> partial[gym.Env]:
        """Function that builds one environment; see `make_single_env`."""
        assert self.episode_length is not None  # filled in by __post_init__
        return partial(
            make_single_env, str(self.task), self.episode_length, self.gym_kwargs, self.render_mode
        )
