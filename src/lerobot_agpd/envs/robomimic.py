"""LeRobot environment type `robomimic`: the simulated tasks of robomimic (arXiv:2108.03298) in robosuite 1.5.

The raw keys become `observation.state`, `observation.environment_state` and `observation.images.<camera>`. The tasks
are in `robomimic_tasks`, the simulation in `robosuite_sim`.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_agpd.envs.base import (
    AGENT_POS,
    ENVIRONMENT_STATE,
    PIXELS,
    SingleEnvConfig,
    require_packages,
)
from lerobot_agpd.envs.robomimic_tasks import FPS, OBSERVED_KEYS, get_task


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
    require_packages(["lerobot_agpd.envs.robosuite_sim", "robosuite"], "robomimic", extra="robomimic")
    from lerobot_agpd.envs.robosuite_sim import RobosuiteEnv, View

    env = RobosuiteEnv(task, View(**view_kwargs), render_mode)
    return gym.wrappers.TimeLimit(env, episode_length)


@EnvConfig.register_subclass("robomimic")
@dataclass
class RobomimicEnvConfig(SingleEnvConfig, EnvConfig):
    """Tasks of robomimic with one Panda, or two, seen through their state or through cameras."""

    task: str | None = "lift"  # lift, can, square, transport or tool_hang
    fps: int = FPS  # control steps per second; robomimic has 20 only
    episode_length: int | None = None  # steps after which an episode is truncated; None: robomimic's horizon
    obs_type: str = "state"  # state, pixels_agent_pos or pixels
    cameras: list[str] | None = (
        None  # observed cameras, e.g. "[agentview]"; None: those of robomimic's datasets
    )
    observation_height: int = 84  # height of observed images, pixels; robomimic has 240 for tool_hang
    observation_width: int = 84  # width of observed images, pixels
    visualization_height: int = 480  # height of rendered frames, pixels
    visualization_width: int = 480  # width of rendered frames, pixels
    render_mode: str = "rgb_array"  # gymnasium's render mode; nothing is rendered unless asked for
    features: dict[str, PolicyFeature] = field(default_factory=dict)  # derived from the task
    features_map: dict[str, str] = field(
        default_factory=dict
    )  # raw key to LeRobot key, derived from the task

    def __post_init__(self) -> None:
        """Fill in what depends on the task and derive the features.

        Raises:
            ValueError: if an option is unknown or does not fit the task.
        """
        task = get_task(self.task)
        self.check_options(OBSERVED_KEYS, FPS, task.episode_length)
        if self.render_mode != "rgb_array":
            raise ValueError(f"--env.render_mode={self.render_mode}: only rgb_array can be rendered.")
        if self.cameras is None:
            self.cameras = list(task.cameras)
        known = (*task.cameras, *task.more_cameras)
        if not self.cameras or not set(self.cameras) <= set(known):
            raise ValueError(
                f"--env.cameras={self.cameras} must name at least one of {', '.join(known)} for {self.task}."
            )
        self._derive_features()

    def _derive_features(self) -> None:
        task = get_task(self.task)
        keys = OBSERVED_KEYS[self.obs_type]
        image = PolicyFeature(FeatureType.VISUAL, (self.observation_height, self.observation_width, 3))
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (task.action_dim,))}
        self.features_map = {ACTION: ACTION, AGENT_POS: OBS_STATE, ENVIRONMENT_STATE: OBS_ENV_STATE}
        if AGENT_POS in keys:
            self.features[AGENT_POS] = PolicyFeature(FeatureType.STATE, (task.agent_pos_dim,))
        if ENVIRONMENT_STATE in keys:
            self.features[ENVIRONMENT_STATE] = PolicyFeature(FeatureType.ENV, (task.environment_state_dim,))
        for camera in self._observed_cameras:
            self.features[f"{PIXELS}/{camera}"] = image
            self.features_map[f"{PIXELS}/{camera}"] = f"{OBS_IMAGES}.{camera}"

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
        """Builds one environment; see `make_single_env`."""
        assert self.episode_length is not None  # filled in by __post_init__
        return partial(
            make_single_env, str(self.task), self.episode_length, self.gym_kwargs, self.render_mode
        )
