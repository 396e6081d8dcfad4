"""LeRobot environment type `fetch_ways`: manipulation with Fetch of Gymnasium-Robotics that can be done in several ways.

The tasks are in `fetch_ways_tasks`, the simulation in `fetch_ways_sim`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_agpd.envs.fetch_ways_tasks import TASKS
from lerobot_agpd.envs.free_camera import FreeCameraEnvConfig
from lerobot_agpd.envs.packages import require_packages
from lerobot_agpd.envs.poses import FETCH_POSE, FETCH_POSES, CameraPose


@EnvConfig.register_subclass("fetch_ways")
@dataclass
class FetchWaysEnv(FreeCameraEnvConfig):
    """Fetch with several places, blocks or sides to choose from, seen through its state or cameras."""

    tasks = TASKS

    # Task: PickAndPlaceAnyPlace-v0, PickAnyBlock-v0, ReachAnyPlace-v0 or PushEitherSide-v0.
    task: str | None = "PickAndPlaceAnyPlace-v0"

    @property
    def task_pose(self) -> CameraPose:
        """Pose of the main camera."""
        return FETCH_POSE

    @property
    def task_poses(self) -> Mapping[str, CameraPose]:
        """Poses of the named cameras."""
        return FETCH_POSES

    def make_single(self) -> gym.Env:
        """Build one wrapped environment; see `SimulatedEnvConfig.make_single`."""
        require_packages(["gymnasium_robotics", "mujoco"], "--env.type=fetch_ways", extra="fetch")
        from lerobot_agpd.envs.fetch_ways_sim import FetchWays
        from lerobot_agpd.envs.robotics_wrapper import RoboticsWrapper

        assert self.episode_length is not None  # filled in by __post_init__
        task = TASKS[str(self.task)]
        env = gym.wrappers.TimeLimit(FetchWays(task), self.episode_length)
        return RoboticsWrapper(env, str(self.task), task, self.view)
