"""LeRobot environment type `gymnasium_robotics`: Fetch, the Adroit hand and the Franka kitchen.

Observations are split into LeRobot's raw keys:

- `agent_pos`: joints and gripper of the robot (becomes `observation.state`);
- `environment_state`: objects and, where there is one, the desired goal (becomes `observation.environment_state`);
- `pixels`: one camera image (becomes `observation.image`), or several (`observation.images.<camera>`).

The tasks are in `robotics_tasks`, the wrapper in `robotics_wrapper`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_agpd.envs.base import require_choice
from lerobot_agpd.envs.free_camera import FreeCameraEnvConfig
from lerobot_agpd.envs.packages import require_packages
from lerobot_agpd.envs.poses import CameraPose
from lerobot_agpd.envs.robotics_tasks import KITCHEN, KITCHEN_DEFAULT, KITCHEN_TASKS, TASKS
from lerobot_agpd.flag_checks import require


@EnvConfig.register_subclass("gymnasium_robotics")
@dataclass
class GymnasiumRoboticsEnv(FreeCameraEnvConfig):
    """Tasks of Gymnasium-Robotics, seen through their state or cameras."""

    tasks = TASKS

    # Task of Gymnasium-Robotics, e.g. FetchReach-v4, AdroitHandDoor-v1 or FrankaKitchen-v1.
    task: str | None = "FetchPickAndPlace-v4"
    # FrankaKitchen-v1 only: the tasks that make a success, e.g. "[kettle]"; default: D4RL's kitchen-complete.
    tasks_to_complete: list[str] | None = None

    def __post_init__(self) -> None:
        """Check the options, fill in what depends on the task and derive the features.

        Raises:
            FlagError: if an option is unknown or does not fit the task.
        """
        super().__post_init__()
        require(
            self.task == KITCHEN or self.tasks_to_complete is None,
            f"--env.tasks_to_complete={self.tasks_to_complete} belongs to {KITCHEN}, not to {self.task}",
        )
        if self.tasks_to_complete is not None:
            require_choice("tasks_to_complete", self.tasks_to_complete, KITCHEN_TASKS)

    @property
    def task_pose(self) -> CameraPose | None:
        """Pose of the task's main camera."""
        return TASKS[str(self.task)].pose

    @property
    def task_poses(self) -> Mapping[str, CameraPose]:
        """Poses of the task's named cameras."""
        return TASKS[str(self.task)].poses

    def make_single(self) -> gym.Env:
        """Build one wrapped environment; see `SimulatedEnvConfig.make_single`."""
        require_packages(["gymnasium_robotics", "mujoco"], "--env.type=gymnasium_robotics", extra="fetch")
        from lerobot_agpd.envs.robotics_wrapper import RoboticsWrapper

        kitchen = {"tasks_to_complete": self.tasks_to_complete or list(KITCHEN_DEFAULT)}
        env = gym.make(
            str(self.task),
            max_episode_steps=self.episode_length,
            disable_env_checker=self.disable_env_checker,
            render_mode=self.render_mode,
            **(kitchen if self.task == KITCHEN else {}),
        )
        return RoboticsWrapper(env, str(self.task), TASKS[str(self.task)], self.view)
