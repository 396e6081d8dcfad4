"""LeRobot environment type `aloha_state`: ALOHA's simulated tasks with object poses instead of images.

The raw keys become `observation.state`, `observation.environment_state` and `observation.images.<camera>`. The
simulation is in `aloha_sim`.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import AlohaEnv as LeRobotAlohaEnv, EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_agpd.envs.base import (
    AGENT_POS,
    ENVIRONMENT_STATE,
    PIXELS,
    SingleEnvConfig,
    require_packages,
)

FPS = 50
CAMERAS = ("top", "angle", "front_close", "left_pillar", "right_pillar", "left_wrist", "right_wrist")
ALOHA_TASKS: dict[str, tuple[str, int]] = {
    "AlohaTransferCube-v0": ("transfer_cube", 1),
    "AlohaInsertion-v0": ("insertion", 2),
}
"""LeRobot's task to gym_aloha's name and its number of objects."""

OBSERVED_KEYS: dict[str, tuple[str, ...]] = {
    "environment_state_agent_pos": (AGENT_POS, ENVIRONMENT_STATE),
    "pixels_agent_pos": (AGENT_POS, PIXELS),
    "pixels": (PIXELS,),
    "pixels_environment_state_agent_pos": (AGENT_POS, ENVIRONMENT_STATE, PIXELS),
}
"""Raw keys of every `--env.obs_type`."""


def make_single_env(task: str, episode_length: int, kwargs: dict[str, Any]) -> gym.Env:
    """Build one environment; a worker process that has imported nothing yet can call it.

    Args:
        task: key of `ALOHA_TASKS`.
        episode_length: steps after which an episode is truncated.
        kwargs: for `aloha_sim.AlohaStateEnv`.

    Raises:
        ModuleNotFoundError: if gym_aloha is not installed.
    """
    require_packages(["gym_aloha"], "aloha_state", extra="aloha")
    from lerobot_agpd.envs.aloha_sim import AlohaStateEnv
    from lerobot_agpd.envs.workers import TASKS as DESCRIPTIONS, TaskDescription

    name, _ = ALOHA_TASKS[task]
    env = gym.wrappers.TimeLimit(AlohaStateEnv(name, **kwargs), episode_length)
    return TaskDescription(env, DESCRIPTIONS[f"gym_aloha/{task}"])


@EnvConfig.register_subclass("aloha_state")
@dataclass
class AlohaStateEnvConfig(SingleEnvConfig, LeRobotAlohaEnv):
    """ALOHA's simulated tasks, seen through joints and object poses, or through cameras of any size."""

    task: str | None = "AlohaTransferCube-v0"  # or AlohaInsertion-v0
    obs_type: str = "environment_state_agent_pos"  # or pixels, pixels_agent_pos, ...
    observation_height: int = 240  # height of observed images, pixels
    observation_width: int = 320  # width of observed images, pixels
    visualization_height: int = 480  # height of rendered frames, pixels
    visualization_width: int = 640  # width of rendered frames, pixels
    cameras: list[str] = field(default_factory=lambda: ["top"])  # observed cameras, e.g. "[top,angle]"
    shadows: bool = True  # draw shadows; without a GPU an image is many times faster without

    def __post_init__(self) -> None:
        """Derive the features.

        Raises:
            ValueError: if an option is unknown or impossible.
        """
        if self.task not in ALOHA_TASKS:
            raise ValueError(f"--env.task must be one of {', '.join(ALOHA_TASKS)}; got {self.task!r}.")
        self.check_options(OBSERVED_KEYS, FPS)
        unknown = [camera for camera in self.cameras if camera not in CAMERAS]
        if unknown or not self.cameras:
            raise ValueError(f"--env.cameras={self.cameras} must name at least one of {', '.join(CAMERAS)}.")
        keys = OBSERVED_KEYS[self.obs_type]
        image = PolicyFeature(FeatureType.VISUAL, (self.observation_height, self.observation_width, 3))
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (14,))}
        self.features_map = {ACTION: ACTION, AGENT_POS: OBS_STATE, ENVIRONMENT_STATE: OBS_ENV_STATE}
        if AGENT_POS in keys:
            self.features[AGENT_POS] = PolicyFeature(FeatureType.STATE, (14,))
        if ENVIRONMENT_STATE in keys:
            self.features[ENVIRONMENT_STATE] = PolicyFeature(
                FeatureType.ENV, (7 * ALOHA_TASKS[self.task][1],)
            )
        for camera in self.cameras if PIXELS in keys else ():
            self.features[f"{PIXELS}/{camera}"] = image
            self.features_map[f"{PIXELS}/{camera}"] = f"{OBS_IMAGES}.{camera}"

    @property
    def package_name(self) -> str:
        """Package that holds the simulation."""
        return "gym_aloha"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keyword arguments for `aloha_sim.AlohaStateEnv`."""
        return {
            "keys": OBSERVED_KEYS[self.obs_type],
            "cameras": tuple(self.cameras),
            "shadows": self.shadows,
            "render_mode": self.render_mode,
            "observation_width": self.observation_width,
            "observation_height": self.observation_height,
            "visualization_width": self.visualization_width,
            "visualization_height": self.visualization_height,
        }

    @property
    def factory(self) -> partial[gym.Env]:
        """Builds one environment; see `make_single_env`."""
        assert self.episode_length is not None  # checked by __post_init__
        return partial(make_single_env, str(self.task), self.episode_length, self.gym_kwargs)
