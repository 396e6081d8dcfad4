"""LeRobot environment type `pusht_state`: gym_pusht's Push-T with the block's corners and an image at once.

The raw keys become `observation.state`, `observation.environment_state` and `observation.image`. The simulation is in
`pusht_sim`.
"""

from dataclasses import dataclass

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_agpd.envs.base import DESCRIPTIONS, SimulatedEnvConfig, TaskSpec
from lerobot_agpd.envs.packages import require_packages

TASKS = {
    "PushT-v0": TaskSpec(
        description=DESCRIPTIONS["gym_pusht/PushT-v0"],
        fps=10,
        episode_length=300,
        action_dim=2,
        agent_pos_dim=2,
        environment_state_dim=16,
    )
}


@EnvConfig.register_subclass("pusht_state")
@dataclass
class PushTStateEnvConfig(SimulatedEnvConfig):
    """Push-T, seen through corners and the agent's position, or through an image too."""

    tasks = TASKS
    obs_types = ("environment_state_agent_pos", *SimulatedEnvConfig.obs_types[1:])

    # PushT-v0.
    task: str | None = "PushT-v0"
    # What is observed: environment_state_agent_pos, pixels_agent_pos, pixels or pixels_environment_state_agent_pos.
    obs_type: str = "pixels_environment_state_agent_pos"

    def make_single(self) -> gym.Env:
        """Build one environment; see `SimulatedEnvConfig.make_single`."""
        require_packages(["gym_pusht"], "--env.type=pusht_state", extra="pusht")
        from lerobot_agpd.envs.pusht_sim import PushTStateEnv

        assert self.episode_length is not None  # filled in by __post_init__
        return gym.wrappers.TimeLimit(PushTStateEnv(self.view), self.episode_length)
