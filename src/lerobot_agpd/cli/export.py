"""`lerobot-agpd-export`: a student as a plain `act` or `diffusion` checkpoint, or as an ONNX graph."""

import logging
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import torch
from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy, make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.utils.random_utils import seeded_context

from lerobot_agpd.cards.model_card import CARD
from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.files import write_text
from lerobot_agpd.flag_checks import require
from lerobot_agpd.loading import LoadedPolicy, load_policy, read_policy_config
from lerobot_agpd.onnx_policy import export_onnx, require_onnx
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.studies.latency import random_observations

logger = logging.getLogger(__name__)

Format = Literal["lerobot", "onnx"]

TOLERANCE = 1e-6
"""Largest difference between the two policies' normalized actions."""


@dataclass
class ExportConfig:
    """Options of `lerobot-agpd-export`."""

    # Pretrained_model folder (or Hub repository) of a student or teacher of this plugin.
    checkpoint: str
    # Folder to write; must not exist.
    output: Path
    # lerobot: a checkpoint of LeRobot's own policy, which loads without this plugin; onnx: a graph for onnxruntime
    # that holds the normalization, of ACT students (needs the extra onnx).
    format: Format = "lerobot"
    # Hub repository to upload to.
    repo_id: str | None = None
    # Upload the result.
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        if self.output.exists():
            raise FileExistsError(f"--output={self.output} already exists; choose a new folder")
        require(not self.push_to_hub or bool(self.repo_id), "--push_to_hub=true needs --repo_id")
        require(
            self.format == "lerobot" or not self.push_to_hub,
            "--push_to_hub=true uploads checkpoints (--format=lerobot); upload a graph with `hf upload`",
        )


def as_plain(policy: PreTrainedPolicy) -> PreTrainedPolicy:
    """Copy the acting network into one of LeRobot's own policies; what only trained it stays behind.

    Raises:
        ValueError: if LeRobot has no such network.
    """
    config: Any = policy.config
    if isinstance(config, AGPDConfig):
        if config.image_features and config.encoder != "resnet":
            raise ValueError(
                f"--checkpoint has the image encoder '{config.encoder}' (--policy.encoder), which LeRobot's 'act' does not "
                "have: it runs wherever this plugin is installed; to export a student with cameras, train it with "
                "--policy.encoder=resnet"
            )
        return _as(ACTPolicy, ACTConfig, "model.", policy)
    if isinstance(config, DiffusionTransformerConfig) and config.denoiser == "unet":
        return _as(DiffusionPolicy, DiffusionConfig, "diffusion.", policy)
    kind = f"'{config.type}'" + (f" with denoiser '{config.denoiser}'" if hasattr(config, "denoiser") else "")
    raise ValueError(
        f"--checkpoint is a {kind} policy, for which LeRobot has no network of its own; 'agpd' exports to 'act', "
        "and diffusion policies of this plugin with --policy.denoiser=unet export to 'diffusion'"
    )


def _as(
    policy_class: type[PreTrainedPolicy],
    config_class: type[PreTrainedConfig],
    prefix: str,
    policy: PreTrainedPolicy,
) -> PreTrainedPolicy:
    config: Any = config_class(
        **{field.name: getattr(policy.config, field.name) for field in fields(config_class) if field.init}
    )
    config.pretrained_path = None
    config.pretrained_backbone_weights = None  # the weights follow; do not download others first
    plain = policy_class(config)
    weights = {key: value for key, value in policy.state_dict().items() if key.startswith(prefix)}
    plain.load_state_dict(weights, strict=True)
    return plain.to(config.device).eval()


def largest_difference(policy: PreTrainedPolicy, plain: PreTrainedPolicy, batch_size: int = 8) -> float:
    """Largest difference of the two policies' chunks at random normalized observations, from the same noise."""
    observations = random_observations(policy, batch_size)
    chunks = []
    for each in (policy, plain):
        each.reset()
        with seeded_context(0):
            chunks.append(each.predict_action_chunk(dict(observations)))
    return float((chunks[0] - chunks[1]).abs().max())


def load(config: ExportConfig) -> LoadedPolicy:
    """The checkpoint to export.

    Raises:
        FileNotFoundError: if there is none.
    """
    policy_config: Any = read_policy_config(config.checkpoint, "--checkpoint")
    if hasattr(policy_config, "pretrained_backbone_weights"):
        policy_config.pretrained_backbone_weights = None
    if config.format == "onnx":
        policy_config.device = "cpu"
    return load_policy(policy_config)


def export(config: ExportConfig) -> PreTrainedPolicy:
    """Write the plain checkpoint with its processors, and the card of the one that it was made of.

    Raises:
        FileNotFoundError: if there is no checkpoint.
        ValueError: if LeRobot has no policy with the checkpoint's network.
        RuntimeError: if the exported policy acts differently.
    """
    loaded = load(config)
    plain = as_plain(loaded.policy)
    difference = largest_difference(loaded.policy, plain)
    if difference > TOLERANCE:
        raise RuntimeError(f"the exported policy's actions differ by {difference:.2e}")
    plain.save_pretrained(config.output)
    for processor in (loaded.preprocessor, loaded.postprocessor):
        processor.save_pretrained(config.output)
    card = Path(config.checkpoint) / CARD
    if card.is_file():
        write_text(config.output / CARD, card.read_text())
    logger.info(
        "%s checkpoint in %s; largest difference of actions %.1e", plain.name, config.output, difference
    )
    return plain


def export_graph(config: ExportConfig) -> None:
    """Write `policy.onnx` and say how fast it is.

    Raises:
        FileNotFoundError: if there is no checkpoint.
        FlagError: if the policy is not an ACT student.
        RuntimeError: if the graph acts differently.
    """
    loaded = load(config)
    require_onnx(loaded.policy)
    result = export_onnx(loaded, config.output)
    logger.info(
        "%s; largest difference of actions %.1e; a chunk takes %.2f ms with torch, %.2f ms with onnxruntime (%d threads)",
        result.path,
        result.difference,
        result.torch_ms,
        result.onnx_ms,
        torch.get_num_threads(),
    )


@entry_point("lerobot-agpd-export")
def main(config: ExportConfig) -> None:
    """Export and optionally upload."""
    if config.format == "onnx":
        export_graph(config)
        return
    plain = export(config)
    if config.push_to_hub:
        repository = str(config.repo_id)
        url = plain.push_to_hub(repository)
        for processor in make_pre_post_processors(plain.config, pretrained_path=str(config.output)):
            processor.push_to_hub(repository)
        card = config.output / CARD
        if card.is_file():
            ModelCard.load(card).push_to_hub(repository)
        logger.info("uploaded to %s", url)


if __name__ == "__main__":
    main()
