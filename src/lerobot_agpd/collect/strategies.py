"""From `--policy.collect.strategy` to who decides what is executed.

replay   the teacher alone                                  deciders/teacher.py   PD
guided   the teacher, guided toward the student             deciders/teacher.py   AGPD, Eq. 19-20
mixing   teacher and student share the actions              deciders/mixing.py    DAgger, Eq. 6-7
rollin   the student begins, the (guided) teacher finishes  deciders/rollin.py    not in the paper
"""

from __future__ import annotations

from typing import Any

import torch

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.collect.decider import Decider
from lerobot_agpd.collect.deciders.mixing import MixedPolicies
from lerobot_agpd.collect.deciders.pair import Pair, PairDecider
from lerobot_agpd.collect.deciders.rollin import RollIn
from lerobot_agpd.collect.deciders.teacher import GuidedTeacher, TeacherAlone
from lerobot_agpd.collect.witness import Witness


def round_strength(config: CollectConfig, number: int, guidance_scale: float) -> float:
    """What the episodes of a round carry as their scale.

    Args:
        config: the strategy.
        number: of the round.
        guidance_scale: the scale that guidance has reached.

    Returns:
        The guidance scale, with `mixing` the student's weight lambda, with `replay` 0.
    """
    if config.strategy == "mixing":
        return config.mixing.weight_at(number)
    return guidance_scale if config.guides else 0.0


def make_decider(config: Any, pair: Pair, generator: torch.Generator) -> Decider:
    """The strategy that `config.collect` asks for, watched if its diagnostics want to know.

    Args:
        config: the student's configuration, with the groups `collect` and `guidance`.
        pair: teacher and student.
        generator: of the sampling noise.

    Raises:
        ValueError: if the strategy guides and the teacher cannot be guided.
    """
    collect = config.collect
    if needs_guidance(config):
        pair.teacher.require_guidance(config.guidance.at)
    decider = make_strategy(config, pair, generator)
    if collect.diagnostics.observations == 0:
        return decider
    return Witness(decider, collect.diagnostics.observations, seed=generator.initial_seed())


def needs_guidance(config: Any) -> bool:
    """Whether the teacher must be one that can be guided; roll-in with a scale of 0 leaves it alone."""
    strategy = config.collect.strategy
    return strategy == "guided" or (strategy == "rollin" and config.guidance.scale > 0)


def make_strategy(config: Any, pair: Pair, generator: torch.Generator) -> PairDecider:
    """The strategy that `config.collect` asks for, made of a teacher and a student."""
    collect = config.collect
    if collect.strategy == "replay":
        return TeacherAlone(pair, generator)
    if collect.strategy == "mixing":
        return MixedPolicies(pair, generator, collect.mixing)
    guided = GuidedTeacher(pair, generator, config.guidance, collect.variation.quantile)
    return RollIn(pair, guided) if collect.strategy == "rollin" else guided
