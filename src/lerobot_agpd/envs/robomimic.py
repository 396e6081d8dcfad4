"""LeRobot environment type `robosuite_robomimic`: the simulated tasks of robomimic (arXiv:2108.03298) in robosuite 1.5.

The raw keys become `observation.state`, `observation.environment_state` and `observation.images.<camera>`. The tasks
are in `robomimic_tasks`, the simulation in `robosuite_sim`.
"""

from dataclasses import dataclass

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_agpd.envs.base import SimulatedEnvConfig, require_choice
from lerobot_agpd.envs.packages import require_packages
from lerobot_agpd.envs.robomimic_tasks import TASKS


@EnvConfig.register_subclass("robosuite_robomimic")
@dataclass
class RobomimicEnvConfig(SimulatedEnvConfig):
    """Tasks of robomimic with one Panda, or two, seen through their state or through cameras."""

    tasks = TASKS

    # Task of robomimic: lift, can, square, transport or tool_hang.
    task: str | None = "lift"
    # Cameras to observe, e.g. '["agentview"]'; default: those of robomimic's image datasets.
    cameras: list[str] | None = None
    # Height of observed images, pixels; robomimic has 240 for tool_hang.
    observation_height: int = 84
    # Width of observed images, pixels.
    observation_width: int = 84

    def __post_init__(self) -> None:
        """Check the options, fill in what depends on the task and derive the features.

        Raises:
            FlagError: if an option is unknown or does not fit the task.
        """
        super().__post_init__()
        task = TASKS[str(self.task)]
        require_choice("cameras", list(self.observed_cameras), (*task.cameras, *task.more_cameras))

    @property
    def observed_cameras(self) -> tuple[str, ...]:
        """Cameras whose images are observed."""
        return TASKS[str(self.task)].cameras if self.cameras is None else tuple(self.cameras)

    def make_single(self) -> gym.Env:
        """Build one environment; see `SimulatedEnvConfig.make_single`."""
        # Our module first: it silences robosuite's warnings before it imports robosuite.
        modules = ["lerobot_agpd.envs.robosuite_sim", "robosuite"]
        require_packages(modules, "--env.type=robosuite_robomimic", extra="robomimic")
        from lerobot_agpd.envs.robosuite_sim import RobosuiteEnv

        assert self.episode_length is not None  # filled in by __post_init__
        return gym.wrappers.TimeLimit(RobosuiteEnv(str(self.task), self.view), self.episode_length)
