"""An environment configuration with the features of the small dataset; nothing is ever rolled out in it."""

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig, PushtEnv


@EnvConfig.register_subclass("fits_the_small_dataset")
class FittingEnv(PushtEnv):
    """Says that it delivers what the small dataset holds."""

    def __post_init__(self):
        self.features = {
            "agent_pos": PolicyFeature(FeatureType.STATE, (2,)),
            "environment_state": PolicyFeature(FeatureType.ENV, (3,)),
            "action": PolicyFeature(FeatureType.ACTION, (2,)),
        }
