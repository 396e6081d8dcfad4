"""LeRobot environment type `fetch_ways`: manipulation with Fetch of Gymnasium-Robotics that can be done in several ways.

The tasks are in `fetch_ways_tasks`, the simulation in `fetch_ways_sim`.
"""

from dataclasses import dataclass

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_agpd.envs.base import SimulatedEnvConfig
from lerobot_agpd.envs.fetch_ways_tasks import TASKS
from lerobot_agpd.envs.packages import require_packages


@EnvConfig.register_subclass("fetch_ways")
@dataclass
class FetchWaysEnv(SimulatedEnvConfig):
    """Fetch with several places, blocks or sides to choose from, seen through its state or one camera."""

    tasks = TASKS

    # Task: PickAndPlaceAnyPlace-v0, PickAnyBlock-v0, ReachAnyPlace-v0 or PushEitherSide-v0.
    task: str | None = "PickAndPlaceAnyPlace-v0"

    def make_single(self) -> gym.Env:
        """Build one wrapped environment; see `SimulatedEnvConfig.make_single`."""
        require_packages(["gymnasium_robotics", "mujoco"], "--env.type=fetch_ways", extra="fetch")
        from lerobot_agpd.envs.fetch_ways_sim import FetchWays
        from lerobot_agpd.envs.robotics_wrapper import RoboticsWrapper

        assert self.episode_length is not None  # filled in by __post_init__
        task = TASKS[str(self.task)]
        env = gym.wrappers.TimeLimit(FetchWays(task), self.episode_length)
        return RoboticsWrapper(env, str(self.task), task, self.view)
