"""Processors of the ACT student trained by AGPD."""

from __future__ import annotations

from typing import Any

from lerobot.policies.act.processor_act import make_act_pre_post_processors
from lerobot.processor import PolicyAction, PolicyProcessorPipeline

from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.replay.normalization import Statistics, training_statistics


def make_agpd_pre_post_processors(
    config: AGPDConfig, dataset_stats: Statistics | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """LeRobot's ACT processors, with statistics that no constant feature can blow up."""
    statistics = training_statistics(config, dataset_stats) if dataset_stats is not None else None
    return make_act_pre_post_processors(config, statistics)
