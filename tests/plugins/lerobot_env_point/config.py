"""`--env.type=point`."""

from dataclasses import dataclass, field

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE


@EnvConfig.register_subclass("point")
@dataclass
class PointEnv(EnvConfig):
    """A point that walks to a goal; LeRobot's own `create_envs` builds it from its Gymnasium id."""

    task: str | None = "Point-v0"
    fps: int = 10
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(FeatureType.ACTION, (2,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (2,)),
            "environment_state": PolicyFeature(FeatureType.ENV, (2,)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
        }
    )

    @property
    def package_name(self) -> str:
        return "lerobot_env_point"

    @property
    def gym_kwargs(self) -> dict:
        return {}
