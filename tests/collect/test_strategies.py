from dataclasses import dataclass, field

import pytest
import torch
from toy_policies import NoisyTeacher, Replayer, alignment, histories, noise, propose

from lerobot_agpd.collect.config import (
    CollectConfig,
    DiagnosticsConfig,
    MixingConfig,
    VariationConfig,
)
from lerobot_agpd.collect.deciders.mixing import MixedPolicies
from lerobot_agpd.collect.deciders.pair import Pair
from lerobot_agpd.collect.deciders.rollin import RollIn
from lerobot_agpd.collect.deciders.teacher import GuidedTeacher, TeacherAlone
from lerobot_agpd.collect.strategies import make_decider, round_strength
from lerobot_agpd.collect.witness import Witness
from lerobot_agpd.guidance.config import GuidanceConfig


@dataclass
class StudentConfig:
    collect: CollectConfig
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)


def decider(collect, teacher=None, guidance=None):
    teacher = teacher or NoisyTeacher()
    config = StudentConfig(collect, guidance or GuidanceConfig())
    return make_decider(config, Pair(teacher, propose, alignment(teacher), student_n_obs_steps=3), noise())


def quiet(**options) -> CollectConfig:
    return CollectConfig(diagnostics=DiagnosticsConfig(observations=0), **options)


@pytest.mark.parametrize(
    ("strategy", "kind"),
    [("replay", TeacherAlone), ("guided", GuidedTeacher), ("mixing", MixedPolicies), ("rollin", RollIn)],
)
def test_strategy_by_name(strategy, kind):
    made = decider(quiet(strategy=strategy))
    assert type(made) is kind and made.n_obs_steps == 3
    watched = decider(CollectConfig(strategy=strategy))
    assert isinstance(watched, Witness) and type(watched.decider) is kind and watched.size == 32


def test_flags_reach_their_strategy():
    variation = VariationConfig(quantile=0.25)
    assert decider(quiet(variation=variation)).quantile == 0.25
    assert decider(quiet(strategy="rollin", variation=variation)).finisher.quantile == 0.25
    mixing = MixingConfig(form="switch", relabel=True)
    assert decider(quiet(strategy="mixing", mixing=mixing)).config is mixing


@pytest.mark.parametrize("strategy", ["guided", "rollin"])
def test_teacher_that_cannot_be_guided_is_refused(strategy):
    with pytest.raises(ValueError, match="--policy.collect.strategy=replay"):
        decider(quiet(strategy=strategy), Replayer())


def test_teacher_that_cannot_be_guided_serves_the_rest():
    unguided = GuidanceConfig(scale=0.0)
    for made in (
        decider(quiet(strategy="replay"), Replayer()),
        decider(quiet(strategy="mixing"), Replayer()),
        decider(quiet(strategy="rollin"), Replayer(), unguided),
    ):
        rolling_in = torch.tensor([True, False, False, False, False])
        made.decide(histories(length=3), torch.zeros(5), rolling_in)


def test_strength_of_a_round():
    assert round_strength(CollectConfig(strategy="replay"), 3, 0.7) == 0.0
    assert round_strength(CollectConfig(strategy="guided"), 3, 0.7) == 0.7
    assert round_strength(CollectConfig(strategy="rollin"), 3, 0.7) == 0.7
    mixing = MixingConfig(weight=0.4, schedule="linear", rounds=8)
    assert round_strength(CollectConfig(strategy="mixing", mixing=mixing), 2, 0.7) == pytest.approx(0.1)
