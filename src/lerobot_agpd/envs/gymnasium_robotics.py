"""LeRobot environment type `gymnasium_robotics`: Fetch, the Adroit hand and the Franka kitchen.

Observations are split into LeRobot's raw keys:

- `agent_pos`: what the robot knows of itself (becomes `observation.state`);
- `environment_state`: objects and, where there is one, the desired goal (becomes `observation.environment_state`);
- `pixels`: one camera image (becomes `observation.image`).

The tasks are in `robotics_tasks`, the wrapper in `robotics_wrapper`.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE

from lerobot_agpd.envs.base import (
    AGENT_POS,
    ENVIRONMENT_STATE,
    PIXELS,
    SingleEnvConfig,
    require_packages,
)
from lerobot_agpd.envs.robotics_tasks import (
    KITCHEN,
    KITCHEN_DEFAULT,
    KITCHEN_TASKS,
    OBSERVED_KEYS,
    get_task_spec,
)


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
    require_packages(["gymnasium_robotics", "mujoco"], "gymnasium_robotics", extra="fetch")
    from lerobot_agpd.envs.robotics_wrapper import RoboticsWrapper, View

    view = View(obs_type, observation_size, visualization_size, shadows)
    return RoboticsWrapper(gym.make(task, **gym_kwargs), task, view)


@EnvConfig.register_subclass("gymnasium_robotics")
@dataclass
class GymnasiumRoboticsEnv(SingleEnvConfig, EnvConfig):
    """Tasks of Gymnasium-Robotics, seen through their state or one camera."""

    task: str | None = "FetchPickAndPlace-v4"  # FetchReach-v4, ..., AdroitHandDoor-v1, ..., FrankaKitchen-v1
    fps: int | None = None  # control steps per second; the simulation allows its own only (None)
    episode_length: int | None = None  # steps after which an episode is truncated; None: the task's own limit
    obs_type: str = "state"  # state, pixels or pixels_agent_pos
    observation_width: int = 96  # width of observed images, pixels
    observation_height: int = 96  # height of observed images, pixels
    render_mode: str = "rgb_array"  # gymnasium's render mode; nothing is rendered unless asked for
    visualization_width: int = 480  # width of rendered frames, pixels
    visualization_height: int = 480  # height of rendered frames, pixels
    shadows: bool = True  # draw shadows; without a GPU Adroit's images are several times faster without
    tasks_to_complete: list[str] | None = (
        None  # FrankaKitchen-v1 only: what success asks for, e.g. "[kettle]"
    )
    features: dict[str, PolicyFeature] = field(default_factory=dict)  # derived from the task
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            AGENT_POS: OBS_STATE,
            ENVIRONMENT_STATE: OBS_ENV_STATE,
            PIXELS: OBS_IMAGE,
        }
    )  # raw key to LeRobot key

    def __post_init__(self) -> None:
        """Fill in what depends on the task and derive the features.

        Raises:
            ValueError: if an option is unknown or does not fit the task.
        """
        spec = get_task_spec(self.task)
        self.check_options(OBSERVED_KEYS, spec.fps, spec.episode_length)
        self._check_kitchen_tasks()
        shapes = {
            AGENT_POS: (FeatureType.STATE, (spec.layout.agent_pos_dim,)),
            ENVIRONMENT_STATE: (FeatureType.ENV, (spec.layout.environment_state_dim,)),
            PIXELS: (FeatureType.VISUAL, (self.observation_height, self.observation_width, 3)),
        }
        self.features = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(spec.action_dim,))}
        for key in OBSERVED_KEYS[self.obs_type]:
            self.features[key] = PolicyFeature(type=shapes[key][0], shape=shapes[key][1])

    def _check_kitchen_tasks(self) -> None:
        if self.task != KITCHEN:
            if self.tasks_to_complete is not None:
                raise ValueError(
                    f"--env.tasks_to_complete={self.tasks_to_complete} belongs to {KITCHEN}, not to {self.task}."
                )
            return
        if self.tasks_to_complete is None:
            self.tasks_to_complete = list(KITCHEN_DEFAULT)
        unknown = [task for task in self.tasks_to_complete if task not in KITCHEN_TASKS]
        if unknown or not self.tasks_to_complete:
            raise ValueError(
                f"--env.tasks_to_complete={self.tasks_to_complete} must name at least one of "
                f"{', '.join(KITCHEN_TASKS)}."
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
        """Builds one environment; see `make_single_env`."""
        return partial(
            make_single_env,
            self.gym_id,
            self.gym_kwargs,
            self.obs_type,
            (self.observation_height, self.observation_width),
            (self.visualization_height, self.visualization_width),
            self.shadows,
        )
