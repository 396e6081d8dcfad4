"""When rounds are due, and how the strength of guidance adapts."""

import pytest
from hypothesis import given, strategies as st

from lerobot_agpd.agpd import rounds_due
from lerobot_agpd.config import DEFAULT_PULL, CollectConfig, GuidanceConfig
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.guidance.strength import GROWTH, MIN_STRENGTH, TOLERANCE, next_strength


def steps_of_rounds(last=40, **options):
    """The steps after which another round is due."""
    config = CollectConfig(**options)
    due = [rounds_due(step, config) for step in range(last + 1)]
    return [step for step in range(1, last + 1) for _ in range(due[step] - due[step - 1])]


def test_a_round_after_the_warmup_and_then_every_so_often():
    assert steps_of_rounds(warmup=5, every=10) == [5, 15, 25, 35]
    assert steps_of_rounds(last=4, warmup=1, every=1) == [1, 2, 3, 4]


@pytest.mark.parametrize(("n_rounds", "expected"), [(0, []), (1, [5]), (2, [5, 15]), (9, [5, 15, 25])])
def test_number_of_rounds(n_rounds, expected):
    assert steps_of_rounds(last=30, warmup=5, every=10, rounds=n_rounds) == expected


def test_collection_that_is_off():
    assert steps_of_rounds(warmup=5, every=0) == []


CONFIG = GuidanceConfig(scale=1.0, max_scale=4.0)
TOLERATED = 0.5 - TOLERANCE


@pytest.mark.parametrize(
    ("scale", "guided", "teacher", "expected"),
    [
        (1.0, 0.8, 0.8, GROWTH),
        (1.0, 1.0, 0.2, GROWTH),  # better than the teacher alone
        (1.0, TOLERATED + 0.01, 0.5, GROWTH),
        (1.0, TOLERATED - 0.01, 0.5, 1 / GROWTH),
        (1.0, 0.0, 0.0, 1.0),  # nothing ever succeeds: nothing is known
        (1.0, 0.1, 0.0, GROWTH),
        (3.0, 0.8, 0.8, 4.0),  # upper limit
        (1.5 * MIN_STRENGTH, 0.0, 0.8, MIN_STRENGTH),
        (9.0, 0.8, 0.8, 9.0),  # a first scale beyond the limit never grows
        (9.0, 0.0, 0.8, 9 / GROWTH),  # and comes back
        (MIN_STRENGTH / 2, 0.0, 0.8, MIN_STRENGTH / 2),  # one below never shrinks to something larger
        (1.0, None, 0.8, 1.0),  # nothing was guided
        (1.0, 0.8, None, 1.0),  # nothing to compare with
    ],
)
def test_next_strength(scale, guided, teacher, expected):
    assert next_strength(scale, guided, teacher, CONFIG) == expected


@pytest.mark.parametrize("config", [GuidanceConfig(adaptive=False), GuidanceConfig(scale=0.0)])
def test_a_scale_that_is_fixed_or_zero_stays(config):
    strength = config.first_strength
    assert next_strength(strength, 1.0, 0.0, config) == strength


@pytest.mark.parametrize(
    ("pull", "guided", "max_pull", "reachable", "expected"),
    [
        (0.3, 0.8, 1.0, 1.2, 0.6),
        (0.6, 0.8, 1.0, 1.2, 1.0),  # the limit of the flag
        (0.6, 0.8, 1.0, 0.9, 0.9),  # what the sampler can follow
        (0.6, 0.2, 1.0, 0.9, 0.3),
        (0.6, 0.8, 0.5, 0.9, 0.6),
    ],
)
def test_a_pull_grows_up_to_its_limit_and_to_what_the_sampler_can_follow(
    pull, guided, max_pull, reachable, expected
):
    config = GuidanceConfig(pull=pull, max_pull=max_pull)
    assert next_strength(pull, guided, 0.8, config, reachable) == pytest.approx(expected)


def test_pull_and_scale_exclude_each_other():
    with pytest.raises(FlagError, match=r"--policy.guidance.pull=0.3 and --policy.guidance.scale=0.5"):
        GuidanceConfig(pull=0.3, scale=0.5)
    assert GuidanceConfig().first_strength == DEFAULT_PULL and GuidanceConfig().unit == "pull"
    assert (GuidanceConfig(scale=2.0).first_strength, GuidanceConfig(scale=2.0).unit) == (2.0, "scale")
    assert GuidanceConfig(pull=0.0).first_strength == 0.0, "an explicit 0 is no default"


@given(st.lists(st.booleans(), max_size=30))
def test_an_adapted_scale_stays_within_its_limits(good_rounds):
    scale = CONFIG.scale
    for good in good_rounds:
        following = next_strength(scale, float(good), 0.5, CONFIG)
        assert MIN_STRENGTH <= following <= CONFIG.max_scale and (following >= scale) == (
            good or following == scale
        )
        scale = following
