"""LeRobot environment type `aloha_state`: ALOHA's simulated tasks with object poses instead of images.

The raw keys become `observation.state`, `observation.environment_state` and `observation.images.<camera>`. The
simulation is in `aloha_sim`.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, get_args

import gymnasium as gym
from lerobot.envs.configs import AlohaEnv as LeRobotAlohaEnv, EnvConfig
from lerobot.utils.constants import OBS_IMAGES

from lerobot_agpd.envs.base import (
    AGENT_POS,
    ENVIRONMENT_STATE,
    PIXELS,
    RenderMode,
    SingleEnvConfig,
    require_packages,
)

FPS = 50
Task = Literal["AlohaTransferCube-v0", "AlohaInsertion-v0"]
Camera = Literal["top", "angle", "front_close", "left_pillar", "right_pillar", "left_wrist", "right_wrist"]
ObsType = Literal[
    "environment_state_agent_pos", "pixels_agent_pos", "pixels", "pixels_environment_state_agent_pos"
]

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
    require_packages(["gym_aloha"], "--env.type=aloha_state", extra="aloha")
    from lerobot_agpd.envs.aloha_sim import AlohaStateEnv
    from lerobot_agpd.envs.workers import TASKS as DESCRIPTIONS, TaskDescription

    name, _ = ALOHA_TASKS[task]
    env = gym.wrappers.TimeLimit(AlohaStateEnv(name, **kwargs), episode_length)
    return TaskDescription(env, DESCRIPTIONS[f"gym_aloha/{task}"])


@EnvConfig.register_subclass("aloha_state")
@dataclass
class AlohaStateEnvConfig(SingleEnvConfig, LeRobotAlohaEnv):
    """ALOHA's simulated tasks, seen through joints and object poses, or through cameras of any size."""

    # AlohaTransferCube-v0 or AlohaInsertion-v0.
    task: Task | None = "AlohaTransferCube-v0"
    # Control steps per second; ALOHA has 50 only.
    fps: int = FPS
    # Steps after which an episode is truncated.
    episode_length: int = 400
    # What is observed.
    obs_type: ObsType = "environment_state_agent_pos"
    # Cameras to observe, e.g. "[top,angle]".
    cameras: list[Camera] = field(default_factory=lambda: ["top"])
    # Height of observed images, pixels.
    observation_height: int = 240
    # Width of observed images, pixels.
    observation_width: int = 320
    # Height of rendered frames, pixels.
    visualization_height: int = 480
    # Width of rendered frames, pixels.
    visualization_width: int = 640
    # Draw shadows; without a GPU an image is many times faster without.
    shadows: bool = True
    # gymnasium's render mode; nothing is rendered before `render` is called.
    render_mode: RenderMode = "rgb_array"

    def __post_init__(self) -> None:
        """Check the options and derive the features.

        Raises:
            ValueError: if an option is unknown or impossible.
        """
        if self.task not in ALOHA_TASKS:
            raise ValueError(f"--env.task must be one of {', '.join(ALOHA_TASKS)}; got {self.task!r}.")
        self.check_options(OBSERVED_KEYS, FPS)
        cameras = get_args(Camera)
        if not self.cameras or not set(self.cameras) <= set(cameras):
            raise ValueError(f"--env.cameras={self.cameras} must name at least one of {', '.join(cameras)}.")
        keys = OBSERVED_KEYS[self.obs_type]
        image_keys = {f"{PIXELS}/{camera}": f"{OBS_IMAGES}.{camera}" for camera in self.cameras}
        _, n_objects = ALOHA_TASKS[self.task]
        self.set_features(keys, 14, 14, 7 * n_objects, image_keys if PIXELS in keys else {})

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
        """Function that builds one environment; see `make_single_env`."""
        return partial(make_single_env, str(self.task), self.episode_length, self.gym_kwargs)
