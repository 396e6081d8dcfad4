"""Processors of the diffusion student trained by AGPD."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline

from lerobot_agpd.policies.agpd_diffusion.configuration_agpd_diffusion import AGPDDiffusionConfig
from lerobot_agpd.policies.diffusion_transformer.processor_diffusion_transformer import (
    make_diffusion_transformer_pre_post_processors,
)
from lerobot_agpd.replay.normalization import Statistics


def make_agpd_diffusion_pre_post_processors(
    config: AGPDDiffusionConfig, dataset_stats: Statistics | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Those of the diffusion policy it is."""
    return make_diffusion_transformer_pre_post_processors(config, dataset_stats)
