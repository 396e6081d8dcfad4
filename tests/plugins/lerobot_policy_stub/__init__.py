"""A third-party policy type: the configuration alone."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig


@PreTrainedConfig.register_subclass("stub")
@dataclass
class StubConfig(ACTConfig):
    """LeRobot's ACT under another name."""
