from dataclasses import replace

import numpy as np
import pytest

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.collect.success import SuccessFilter
from lerobot_agpd.replay.episode import Episode, Ticket


def episode(rewards, successes=None) -> Episode:
    length = len(rewards)
    return Episode(
        ticket=Ticket(3, 1_000_007, 0.5),
        task="",
        observations={},
        actions=np.zeros((length, 1), dtype=np.float32),
        rewards=np.array(rewards, dtype=np.float32),
        successes=None if successes is None else np.array(successes, dtype=bool),
        j=0.25,
        shift=0.75,
    )


@pytest.mark.parametrize(
    ("successes", "passed", "trivial"),
    [
        ([0, 0, 1], True, False),
        ([0, 1, 0], False, False),  # solved on the way, not at the end
        ([0, 0, 0], False, False),
        ([1, 0, 1], True, True),  # the start already meets the criterion
        ([1, 0, 0], False, True),
        ([0, 1], True, True),  # too short
        ([1], True, True),
    ],
)
def test_success_is_what_the_environment_says_at_the_last_step(successes, passed, trivial):
    record = SuccessFilter(min_reward=None, min_length=3).judge(episode([9.0] * len(successes), successes))
    assert (record.passed, record.trivial, record.kept) == (passed, trivial, passed and not trivial)
    assert record.success == bool(successes[-1])


@pytest.mark.parametrize(
    ("rewards", "passed", "trivial"),
    [
        ([0.0, 0.9, 0.0], True, False),  # the largest reward, at any step
        ([0.0, 0.0, 0.89], False, False),
        ([0.9, 0.0, 0.0], True, True),
        ([0.1, 0.95], True, True),  # too short
    ],
)
@pytest.mark.parametrize("successes", [None, True, False])
def test_min_reward_replaces_is_success(rewards, passed, trivial, successes):
    reported = None if successes is None else [successes] * len(rewards)
    judge = SuccessFilter(min_reward=np.float32(0.9), min_length=3).judge
    record = judge(episode(rewards, reported))
    assert (record.passed, record.trivial, record.kept) == (passed, trivial, passed and not trivial)
    assert record.success is successes


def test_record_copies_the_episode():
    record = SuccessFilter(None, 2).judge(episode([0.5, 2.0, 1.0], [0, 0, 1]))
    assert (record.number, record.seed, record.scale, record.length) == (3, 1_000_007, 0.5, 3)
    assert (record.max_reward, record.j, record.shift) == (2.0, 0.25, 0.75)


def test_what_the_student_finishes_alone_is_counted_and_not_kept():
    alone = replace(episode([0.5, 2.0, 1.0], [0, 0, 1]), student_alone=True, student_steps=3)
    record = SuccessFilter(None, 2).judge(alone)
    assert record.passed and not record.trivial and not record.kept
    assert record.student_alone and record.student_steps == 3


def test_silent_environment_is_refused():
    with pytest.raises(ValueError, match="is_success.*--policy.collect.min_reward"):
        SuccessFilter(None, 2).judge(episode([0.0, 1.0]))


def test_filter_takes_its_flags():
    config = CollectConfig(min_reward=0.7, min_length=9, keep_failures=True)
    assert SuccessFilter.from_config(config) == SuccessFilter(0.7, 9, True)


@pytest.mark.parametrize(
    ("successes", "kept"), [([0, 0, 0], True), ([0, 0, 1], True), ([1, 0, 0], False), ([0, 0], False)]
)
def test_failures_are_kept_if_asked_for_but_nothing_trivial(successes, kept):
    record = SuccessFilter(None, 3, keep_failures=True).judge(episode([0.0] * len(successes), successes))
    assert (record.passed, record.kept) == (bool(successes[-1]), kept)


@pytest.mark.parametrize(
    "options",
    [
        {"strategy": "dagger"},
        {"every": -1},
        {"warmup": 0},
        {"episodes": 0},
        {"n_envs": 0},
        {"min_length": 0},
        {"rounds": -1},
        {"unguided_fraction": 1.5},
        {"n_action_steps": 0},
        {"push_to_hub": True},
    ],
)
def test_wrong_flags_are_named(options):
    with pytest.raises(ValueError, match=f"--policy.collect.{next(iter(options))}"):
        CollectConfig(**options)
