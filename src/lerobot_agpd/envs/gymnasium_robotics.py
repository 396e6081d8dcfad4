"""LeRobot environment type `gymnasium_robotics`: Fetch, the Adroit hand and the Franka kitchen.

Observations are split into LeRobot's raw keys:

- `agent_pos`: joints and gripper of the robot (becomes `observation.state`);
- `environment_state`: objects and, where there is one, the desired goal (becomes `observation.environment_state`);
- `pixels`: one camera image (becomes `observation.image`).

The tasks are in `robotics_tasks`, the wrapper in `robotics_wrapper`.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, get_args

import gymnasium as gym
from lerobot.configs import PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import OBS_IMAGE

from lerobot_agpd.envs.base import PIXELS, RenderMode, SingleEnvConfig, require_packages
from lerobot_agpd.envs.robotics_tasks import KITCHEN, KITCHEN_DEFAULT, OBSERVED_KEYS, KitchenTask, get_task

Task = Literal[
    "FetchReach-v4",
    "FetchPush-v4",
    "FetchPickAndPlace-v4",
    "FetchSlide-v4",
    "AdroitHandDoor-v1",
    "AdroitHandHammer-v1",
    "AdroitHandPen-v1",
    "AdroitHandRelocate-v1",
    "FrankaKitchen-v1",
]
ObsType = Literal["state", "pixels", "pixels_agent_pos"]


def make_single_env(
    task: str,
    gym_kwargs: dict[str, Any],
    obs_type: str,
    observation_size: tuple[int, int],
    visualization_size: tuple[int, int],
    shadows: bool,
) -> gym.Env:
    """Build one wrapped environment.

    A worker process that has imported nothing yet can call it. No graphics context is opened before the first image.

    Args:
        task: key of `TASKS`.
        gym_kwargs: passed on to `gymnasium.make`.
        obs_type: key of `OBSERVED_KEYS`.
        observation_size: height and width of observed images, pixels.
        visualization_size: height and width of rendered frames, pixels.
        shadows: whether images show shadows.

    Raises:
        ModuleNotFoundError: if Gymnasium-Robotics is not installed.
        ValueError: if the task is not known.
    """
    require_packages(["gymnasium_robotics", "mujoco"], "--env.type=gymnasium_robotics", extra="fetch")
    from lerobot_agpd.envs.robotics_wrapper import RoboticsWrapper, View

    view = View(obs_type, observation_size, visualization_size, shadows)
    return RoboticsWrapper(gym.make(task, **gym_kwargs), task, view)


@EnvConfig.register_subclass("gymnasium_robotics")
@dataclass
class GymnasiumRoboticsEnv(SingleEnvConfig, EnvConfig):
    """Tasks of Gymnasium-Robotics, seen through their state or one camera."""

    # Task of Gymnasium-Robotics.
    task: Task | None = "FetchPickAndPlace-v4"
    # Control steps per second; default: the task's, the only possible value.
    fps: int | None = None
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
    # Draw shadows; without a GPU Adroit's images are several times faster without.
    shadows: bool = True
    # FrankaKitchen-v1 only: the tasks that make a success, e.g. "[kettle]"; default: D4RL's kitchen-complete.
    tasks_to_complete: list[KitchenTask] | None = None
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
        self.check_options(OBSERVED_KEYS, task.fps, task.episode_length)
        self._check_kitchen_tasks()
        keys, layout = OBSERVED_KEYS[self.obs_type], task.layout
        image_keys = {PIXELS: OBS_IMAGE}
        self.set_features(
            keys, task.action_dim, layout.agent_pos_dim, layout.environment_state_dim, image_keys
        )

    def _check_kitchen_tasks(self) -> None:
        if self.task != KITCHEN:
            if self.tasks_to_complete is not None:
                raise ValueError(
                    f"--env.tasks_to_complete={self.tasks_to_complete} belongs to {KITCHEN}, not to {self.task}."
                )
            return
        if self.tasks_to_complete is None:
            self.tasks_to_complete = list(KITCHEN_DEFAULT)
        tasks = get_args(KitchenTask)
        if not self.tasks_to_complete or not set(self.tasks_to_complete) <= set(tasks):
            raise ValueError(
                f"--env.tasks_to_complete={self.tasks_to_complete} must name at least one of {', '.join(tasks)}."
            )

    @property
    def package_name(self) -> str:
        """Package that registers the environments."""
        return "gymnasium_robotics"

    @property
    def gym_id(self) -> str:
        """Id for `gymnasium.make`: the task itself, without a namespace."""
        return str(self.task)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keyword arguments for `gymnasium.make`."""
        kwargs = {
            "render_mode": self.render_mode,
            "width": self.visualization_width,
            "height": self.visualization_height,
            "max_episode_steps": self.episode_length,
            "disable_env_checker": self.disable_env_checker,
        }
        if self.task == KITCHEN:
            kwargs["tasks_to_complete"] = self.tasks_to_complete
        return kwargs

    @property
    def factory(self) -> partial[gym.Env]:
        """Function that builds one environment; see `make_single_env`."""
        return partial(
            make_single_env,
            self.gym_id,
            self.gym_kwargs,
            self.obs_type,
            (self.observation_height, self.observation_width),
            (self.visualization_height, self.visualization_width),
            self.shadows,
        )
