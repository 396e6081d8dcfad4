"""LeRobot environment type `robosuite_robomimic`: the simulated tasks of robomimic (arXiv:2108.03298) in robosuite 1.5.

The raw keys become `observation.state`, `observation.environment_state` and `observation.images.<camera>`. The tasks
are in `robomimic_tasks`, the simulation in `robosuite_sim`.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import gymnasium as gym
from lerobot.configs import PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import OBS_IMAGES

from lerobot_agpd.envs.base import PIXELS, RenderMode, SingleEnvConfig, require_packages
from lerobot_agpd.envs.robomimic_tasks import FPS, OBSERVED_KEYS, get_task

Task = Literal["lift", "can", "square", "transport", "tool_hang"]
ObsType = Literal["state", "pixels_agent_pos", "pixels"]


def make_single_env(task: str, episode_length: int, view_kwargs: dict[str, Any], render_mode: str) -> gym.Env:
    """Build one environment; a worker process that has imported nothing yet can call it.

    Args:
        task: key of `robomimic_tasks.TASKS`.
        episode_length: steps after which an episode is truncated.
        view_kwargs: for `robosuite_sim.View`.
        render_mode: gymnasium's.

    Raises:
        ModuleNotFoundError: if robosuite is not installed.
    """
    # Our module first: it silences robosuite's warnings before it imports robosuite.
    require_packages(
        ["lerobot_agpd.envs.robosuite_sim", "robosuite"], "--env.type=robosuite_robomimic", extra="robomimic"
    )
    from lerobot_agpd.envs.robosuite_sim import RobosuiteEnv, View

    env = RobosuiteEnv(task, View(**view_kwargs), render_mode)
    return gym.wrappers.TimeLimit(env, episode_length)


@EnvConfig.register_subclass("robosuite_robomimic")
@dataclass
class RobomimicEnvConfig(SingleEnvConfig, EnvConfig):
    """Tasks of robomimic with one Panda, or two, seen through their state or through cameras."""

    # Task of robomimic.
    task: Task | None = "lift"
    # Control steps per second; robomimic has 20 only.
    fps: int = FPS
    # Steps after which an episode is truncated; default: robomimic's horizon for its proficient-human data.
    episode_length: int | None = None
    # What is observed.
    obs_type: ObsType = "state"
    # Cameras to observe, e.g. "[agentview]"; default: those of robomimic's image datasets.
    cameras: list[str] | None = None
    # Height of observed images, pixels; robomimic has 240 for tool_hang.
    observation_height: int = 84
    # Width of observed images, pixels.
    observation_width: int = 84
    # Height of rendered frames, pixels.
    visualization_height: int = 480
    # Width of rendered frames, pixels.
    visualization_width: int = 480
    # gymnasium's render mode; nothing is rendered before `render` is called.
    render_mode: RenderMode = "rgb_array"
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
        if self.cameras is None:
            self.cameras = list(task.cameras)
        cameras = (*task.cameras, *task.more_cameras)
        if not self.cameras or not set(self.cameras) <= set(cameras):
            raise ValueError(
                f"--env.cameras={self.cameras} must name at least one of {', '.join(cameras)} for {self.task}."
            )
        image_keys = {f"{PIXELS}/{camera}": f"{OBS_IMAGES}.{camera}" for camera in self._observed_cameras}
        self.set_features(
            OBSERVED_KEYS[self.obs_type],
            task.action_dim,
            task.agent_pos_dim,
            task.environment_state_dim,
            image_keys,
        )

    @property
    def _observed_cameras(self) -> tuple[str, ...]:
        return tuple(self.cameras or ()) if PIXELS in OBSERVED_KEYS[self.obs_type] else ()

    @property
    def package_name(self) -> str:
        """Package that holds the simulation."""
        return "robosuite"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keyword arguments for `robosuite_sim.View`."""
        return {
            "obs_type": self.obs_type,
            "cameras": self._observed_cameras,
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
