"""Processors of the diffusion policy with an exchangeable denoiser."""

from __future__ import annotations

from typing import Any

from lerobot.policies.diffusion.processor_diffusion import make_diffusion_pre_post_processors
from lerobot.processor import PolicyAction, PolicyProcessorPipeline

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.replay.normalization import Statistics, training_statistics


def make_diffusion_transformer_pre_post_processors(
    config: DiffusionTransformerConfig, dataset_stats: Statistics | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """LeRobot's diffusion processors, with statistics whose spread has a lower limit."""
    statistics = training_statistics(config, dataset_stats) if dataset_stats is not None else None
    return make_diffusion_pre_post_processors(config, statistics)
