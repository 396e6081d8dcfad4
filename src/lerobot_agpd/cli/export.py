"""`lerobot-agpd-export`: an AGPD student as a plain `act` checkpoint that loads without this plugin."""

import logging
from dataclasses import dataclass, fields
from pathlib import Path

import draccus
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging
from torch import Tensor

from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy

logger = logging.getLogger(__name__)

TOLERANCE = 1e-6
"""Largest difference between the two policies' normalised actions."""


@dataclass
class ExportConfig:
    """Options of `lerobot-agpd-export`."""

    checkpoint: str  # pretrained_model folder (or Hub repository) of an agpd policy
    output: Path  # folder of the act checkpoint; must not exist
    repo_id: str | None = None  # Hub repository to upload to
    push_to_hub: bool = False  # upload the result

    def __post_init__(self) -> None:
        if self.output.exists():
            raise FileExistsError(f"--output={self.output} already exists; choose a new folder")
        if self.push_to_hub and not self.repo_id:
            raise ValueError("--push_to_hub=true needs --repo_id")


def as_act(policy: AGPDPolicy) -> ACTPolicy:
    """The same network as LeRobot's ACT; discriminator and representation stay behind."""
    config = ACTConfig(**{field.name: getattr(policy.config, field.name) for field in fields(ACTConfig)})
    config.pretrained_path = None
    config.pretrained_backbone_weights = None  # the weights follow; do not download others first
    act = ACTPolicy(config)
    prefix = "model."
    weights = {key: value for key, value in policy.state_dict().items() if key.startswith(prefix)}
    act.load_state_dict(weights, strict=True)
    return act.to(config.device).eval()


def largest_difference(policy: AGPDPolicy, act: ACTPolicy, batch_size: int = 8) -> float:
    """Largest difference of the two policies' chunks at random normalised observations."""
    generator = torch.Generator().manual_seed(0)
    batch: dict[str, Tensor] = {
        key: torch.randn(batch_size, *feature.shape, generator=generator).to(policy.config.device)
        for key, feature in (policy.config.input_features or {}).items()
    }
    return float(
        (policy.predict_action_chunk(dict(batch)) - act.predict_action_chunk(dict(batch))).abs().max()
    )


def export(config: ExportConfig) -> ACTPolicy:
    """Write the act checkpoint with its processors.

    Raises:
        ValueError: if the checkpoint is not an agpd policy.
        RuntimeError: if the exported policy acts differently.
    """
    policy_config = PreTrainedConfig.from_pretrained(config.checkpoint)
    if not isinstance(policy_config, AGPDConfig):
        raise ValueError(
            f"--checkpoint={config.checkpoint} is a '{policy_config.type}' policy; only 'agpd' exports to 'act'"
        )
    policy_config.pretrained_backbone_weights = None
    policy = AGPDPolicy.from_pretrained(config.checkpoint, config=policy_config)
    act = as_act(policy)
    difference = largest_difference(policy, act)
    if difference > TOLERANCE:
        raise RuntimeError(f"the exported policy's actions differ by {difference:.2e}")
    act.save_pretrained(config.output)
    for processor in make_pre_post_processors(policy_config, pretrained_path=config.checkpoint):
        processor.save_pretrained(config.output)
    logger.info("act checkpoint in %s; largest difference of actions %.1e", config.output, difference)
    return act


@draccus.wrap()
def run(config: ExportConfig) -> None:
    """Export and optionally upload."""
    act = export(config)
    if config.push_to_hub:
        act.push_to_hub(str(config.repo_id))
        for processor in make_pre_post_processors(act.config, pretrained_path=str(config.output)):
            processor.push_to_hub(str(config.repo_id))


def main() -> None:
    """Console entry point."""
    init_logging()
    register_third_party_plugins()
    run()


if __name__ == "__main__":
    main()
