"""LeRobot environment type `robosuite_ways`: manipulation in robosuite 1.5 that can be done in several ways.

The tasks are in `lift_tasks`, the simulation in `robosuite_ways_sim`.
"""

from dataclasses import dataclass

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_agpd.envs.base import SimulatedEnvConfig
from lerobot_agpd.envs.lift_tasks import TASKS
from lerobot_agpd.envs.packages import require_packages


@EnvConfig.register_subclass("robosuite_ways")
@dataclass
class RobosuiteWaysEnv(SimulatedEnvConfig):
    """Manipulation with several ways, seen through the state or a camera in front of the robot."""

    tasks = TASKS

    # Task: LiftAny-v0.
    task: str | None = "LiftAny-v0"

    def make_single(self) -> gym.Env:
        """Build one environment; see `SimulatedEnvConfig.make_single`."""
        # Our module first: it silences robosuite's warnings before it imports robosuite.
        modules = ["lerobot_agpd.envs.robosuite_ways_sim", "robosuite"]
        require_packages(modules, "--env.type=robosuite_ways", extra="robomimic")
        from lerobot_agpd.envs.robosuite_ways_sim import LiftWays

        assert self.episode_length is not None  # filled in by __post_init__
        return gym.wrappers.TimeLimit(LiftWays(str(self.task), self.view), self.episode_length)
