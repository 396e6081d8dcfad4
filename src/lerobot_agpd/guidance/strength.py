"""The strength of guidance as the flags give it, a pull or a scale, and the guidance scale k of a teacher for it."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from lerobot_agpd.config import GuidanceConfig
from lerobot_agpd.flag_checks import require
from lerobot_agpd.guidance.pull import acts, largest_pull, scale_of_pull
from lerobot_agpd.guidance.teacher import Teacher

STEPS_FLAG = "--policy.teacher.num_inference_steps"

WEAKEST_PULL = 0.1
"""A teacher that the default cannot pull at least so far is refused."""

GROWTH = 2.0
"""Factor by which the strength of guidance grows after a good round and shrinks after a bad one."""

TOLERANCE = 0.05
"""How far the guided teacher's success rate may fall below its own in a good round."""

MIN_STRENGTH = 0.05
"""An adapted strength, be it a pull or a guidance scale, never falls below this."""


def first_strength(teacher: Teacher, config: GuidanceConfig) -> float:
    """Strength of the first round: what the flags say, or as much of the default pull as the sampler can follow."""
    asked = config.first_strength
    return max(min(asked, largest_strength(teacher, config)), WEAKEST_PULL) if config.is_default else asked


def next_strength(
    strength: float,
    guided_success: float | None,
    teacher_success: float | None,
    config: GuidanceConfig,
    reachable: float = math.inf,
) -> float:
    """Pull (or guidance scale) of the next round: the "adaptive" in AGPD.

    A round is good if guided episodes succeed as often as the teacher's own, up to TOLERANCE; then the strength grows
    by GROWTH, else it shrinks by the same factor. While the student is weak its pull costs success and the strength
    stays small; as the student improves the strength rises. Where nothing succeeds nothing is known, and it stays.

    Args:
        strength: of the finished round.
        guided_success: success rate of its guided episodes, None if there were none.
        teacher_success: success rate of the teacher alone, None if unknown.
        config: upper limit; a first strength beyond a limit only ever moves back toward it.
        reachable: the largest strength that the teacher's sampler can follow.
    """
    if guided_success is None or teacher_success is None:
        return strength
    if not config.adaptive or config.first_strength == 0:
        return strength
    if guided_success == teacher_success == 0:
        return strength
    if guided_success >= teacher_success - TOLERANCE:
        return max(strength, min(strength * GROWTH, config.max_strength, reachable))
    return min(strength, max(strength / GROWTH, MIN_STRENGTH))


def require_strength(
    teacher: Teacher, strength: float, config: GuidanceConfig, steps_flag: str = STEPS_FLAG
) -> None:
    """Refuse a strength that the teacher's sampler cannot follow.

    Args:
        teacher: one that can be guided.
        strength: of the first round; 0 is always possible.
        config: its unit, and where J is differentiated.
        steps_flag: the flag that sets the number of denoising steps.

    Raises:
        FlagError: naming the flag.
    """
    sampler = teacher.sampler
    if strength == 0 or (sampler is None and config.unit == "scale"):
        return
    require(
        sampler is not None,
        f"--policy.guidance.pull is not known for a {teacher.type} teacher, whose denoising steps are not of a known "
        "form; give --policy.guidance.scale instead",
    )
    assert sampler is not None
    require(
        acts(sampler),
        f"{steps_flag}={len(sampler)}: guidance shifts a denoising step by a multiple of its posterior variance, which is 0 "
        f"in every step of this {teacher.type} teacher; take 5 steps or more, or let it act alone "
        "(--policy.collect.strategy=teacher)",
    )
    if config.unit == "scale":
        return
    largest = largest_strength(teacher, config)
    require(
        strength <= largest,
        f"--policy.guidance.pull={strength:g} is out of reach: the {len(sampler)} denoising steps of the {teacher.type} teacher "
        f"pull by at most {math.floor(100 * largest) / 100:g} (--policy.guidance.at={config.at}); lower it, or raise "
        f"{steps_flag}",
    )


def guidance_scale(teacher: Teacher, strength: float, config: GuidanceConfig) -> float:
    """Return k of Eq. 20 for one strength that the teacher can follow (`require_strength`)."""
    if strength == 0 or config.unit == "scale":
        return strength
    sampler = teacher.sampler
    assert sampler is not None
    # Strengths of rows are float32, which may be above what they stand for.
    reachable = min(round(strength, 6), largest_pull(sampler, config.at))
    return scale_of_pull(sampler, reachable, config.at)


def guidance_scales(strength: Tensor, scale_of: Callable[[float], float]) -> Tensor:
    """Return k of every row, (B,), for strengths (B,), given k of one strength."""
    values, row = strength.unique(return_inverse=True)  # a round has two: 0 and its own
    return torch.tensor([scale_of(value) for value in values.tolist()]).to(strength)[row]


def largest_strength(teacher: Teacher, config: GuidanceConfig) -> float:
    """The largest strength that the teacher's sampler can follow."""
    if config.unit == "scale" or teacher.sampler is None:
        return math.inf
    return largest_pull(teacher.sampler, config.at)
