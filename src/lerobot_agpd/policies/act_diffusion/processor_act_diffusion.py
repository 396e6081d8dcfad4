"""Processors of ACT with a diffusion prediction head: those of the diffusion policy, under the name LeRobot looks for."""

from lerobot_agpd.policies.diffusion_transformer.processor_diffusion_transformer import (
    make_diffusion_transformer_pre_post_processors as make_act_diffusion_pre_post_processors,
)

__all__ = ["make_act_diffusion_pre_post_processors"]
