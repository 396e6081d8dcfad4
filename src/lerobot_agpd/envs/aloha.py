"""LeRobot environment type `aloha_state`: ALOHA's simulated tasks with object poses instead of images.

The raw keys become `observation.state`, `observation.environment_state` and `observation.images.<camera>`. The
simulation is in `aloha_sim`.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_agpd.envs.base import DESCRIPTIONS, SimulatedEnvConfig, TaskSpec
from lerobot_agpd.envs.packages import require_packages

CAMERAS = ("top", "angle", "front_close", "left_pillar", "right_pillar", "left_wrist", "right_wrist")

TASKS = {
    task: TaskSpec(
        description=DESCRIPTIONS[f"gym_aloha/{task}"],
        fps=50,
        episode_length=400,
        action_dim=14,
        agent_pos_dim=14,
        environment_state_dim=7 * n_objects,
    )
    for task, n_objects in (("AlohaTransferCube-v0", 1), ("AlohaInsertion-v0", 2))
}


@EnvConfig.register_subclass("aloha_state")
@dataclass
class AlohaStateEnvConfig(SimulatedEnvConfig):
    """ALOHA's simulated tasks, seen through joints and object poses, or through cameras of any size."""

    tasks = TASKS
    obs_types = ("environment_state_agent_pos", *SimulatedEnvConfig.obs_types[1:])

    # AlohaTransferCube-v0 or AlohaInsertion-v0.
    task: str | None = "AlohaTransferCube-v0"
    # What is observed: environment_state_agent_pos, pixels_agent_pos, pixels or pixels_environment_state_agent_pos.
    obs_type: str = "environment_state_agent_pos"
    # Cameras to observe, e.g. '["top","angle"]'.
    cameras: list[str] = field(default_factory=lambda: ["top"])
    # Height of observed images, pixels.
    observation_height: int = 240
    # Width of observed images, pixels.
    observation_width: int = 320
    # Width of rendered frames, pixels.
    visualization_width: int = 640

    @property
    def choices(self) -> dict[str, Iterable[str]]:
        """Possible values of the options that have a few."""
        return {**super().choices, "cameras": CAMERAS}

    @property
    def observed_cameras(self) -> tuple[str, ...]:
        """Cameras whose images are observed."""
        return tuple(self.cameras)

    def make_single(self) -> gym.Env:
        """Build one environment; see `SimulatedEnvConfig.make_single`."""
        require_packages(["gym_aloha"], "--env.type=aloha_state", extra="aloha")
        from lerobot_agpd.envs.aloha_sim import AlohaStateEnv

        assert self.episode_length is not None  # filled in by __post_init__
        return gym.wrappers.TimeLimit(AlohaStateEnv(str(self.task), self.view), self.episode_length)
