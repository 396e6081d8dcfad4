"""When rounds are due, and how the guidance scale adapts."""

import pytest
from hypothesis import given, strategies as st

from lerobot_agpd.agpd import GROWTH, MIN_SCALE, TOLERANCE, next_scale, rounds_due
from lerobot_agpd.config import CollectConfig, GuidanceConfig


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
        (1.5 * MIN_SCALE, 0.0, 0.8, MIN_SCALE),
        (9.0, 0.8, 0.8, 9.0),  # a first scale beyond the limit never grows
        (9.0, 0.0, 0.8, 9 / GROWTH),  # and comes back
        (MIN_SCALE / 2, 0.0, 0.8, MIN_SCALE / 2),  # one below never shrinks to something larger
        (1.0, None, 0.8, 1.0),  # nothing was guided
        (1.0, 0.8, None, 1.0),  # nothing to compare with
    ],
)
def test_next_scale(scale, guided, teacher, expected):
    assert next_scale(scale, guided, teacher, CONFIG) == expected


@pytest.mark.parametrize("config", [GuidanceConfig(adaptive=False), GuidanceConfig(scale=0.0)])
def test_a_scale_that_is_fixed_or_zero_stays(config):
    assert next_scale(config.scale, 1.0, 0.0, config) == config.scale


@given(st.lists(st.booleans(), max_size=30))
def test_an_adapted_scale_stays_within_its_limits(good_rounds):
    scale = CONFIG.scale
    for good in good_rounds:
        following = next_scale(scale, float(good), 0.5, CONFIG)
        assert MIN_SCALE <= following <= CONFIG.max_scale and (following >= scale) == (
            good or following == scale
        )
        scale = following
