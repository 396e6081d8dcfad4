"""The "adaptive" in AGPD: the guidance scale follows what the guided teacher can afford."""

from __future__ import annotations

from lerobot_agpd.guidance.config import GuidanceConfig


def next_scale(
    scale: float, guided_success: float | None, unguided_success: float | None, config: GuidanceConfig
) -> float:
    """Scale of the next collection round.

    A round is good if guided episodes succeed as often as the unguided teacher's, up to a tolerance; then the
    scale grows by `growth`, else it shrinks by the same factor. While the student is weak its pull costs
    success and the scale stays small; as the student improves the scale rises.

    Args:
        scale: scale of the finished round.
        guided_success: success rate of its guided episodes, None if there were none.
        unguided_success: success rate of the teacher's unguided episodes, None if there were none.
        config: limits and step size; a first scale beyond a limit only ever moves back toward it.
    """
    if not config.adaptive or guided_success is None or unguided_success is None or config.scale == 0:
        return scale
    good = guided_success >= unguided_success - config.tolerance
    if good:
        return max(scale, min(scale * config.growth, config.max_scale))
    return min(scale, max(scale / config.growth, config.min_scale))
