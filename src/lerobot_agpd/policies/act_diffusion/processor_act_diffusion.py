"""Processors of ACT with a diffusion prediction head."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline

from lerobot_agpd.policies.act_diffusion.configuration_act_diffusion import ACTDiffusionConfig
from lerobot_agpd.policies.diffusion_transformer.processor_diffusion_transformer import (
    make_diffusion_transformer_pre_post_processors,
)
from lerobot_agpd.replay.normalization import Statistics


def make_act_diffusion_pre_post_processors(
    config: ACTDiffusionConfig, dataset_stats: Statistics | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """The diffusion policy's processors."""
    return make_diffusion_transformer_pre_post_processors(config, dataset_stats)
