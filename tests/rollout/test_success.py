from dataclasses import replace

import numpy as np
import pytest

from lerobot_agpd.config import CollectConfig
from lerobot_agpd.replay.episode import Episode, EpisodeSpec
from lerobot_agpd.rollout.success import classify


def episode(rewards, successes=None) -> Episode:
    return Episode(
        spec=EpisodeSpec(3, 1_000_007, 0.5),
        task="",
        observations={},
        actions=np.zeros((len(rewards), 1), dtype=np.float32),
        rewards=np.array(rewards, dtype=np.float32),
        successes=None if successes is None else np.array(successes, dtype=bool),
        discrepancy=0.25,
        guidance_shift=0.75,
    )


@pytest.mark.parametrize(
    ("successes", "success", "at_start"),
    [
        ([0, 0, 1], True, False),
        ([0, 1, 0], False, False),  # solved on the way, not at the end
        ([0, 0, 0], False, False),
        ([1, 0, 1], True, True),  # the start already meets the criterion
        ([1, 0, 0], False, True),
        ([0, 1], True, False),
        ([1], True, True),
        ([0], False, True),  # too short
    ],
)
@pytest.mark.parametrize("keep_failures", [False, True])
def test_success_is_what_the_environment_says_at_the_last_step(successes, success, at_start, keep_failures):
    config = CollectConfig(keep_failures=keep_failures)
    record = classify(episode([9.0] * len(successes), successes), config)
    assert (record.success, record.solved_at_start) == (success, at_start)
    assert record.kept == ((success or keep_failures) and not at_start)
    assert record.is_success == success


@pytest.mark.parametrize(
    ("rewards", "success", "at_start"),
    [
        ([0.0, 0.9, 0.0], True, False),  # the largest reward, at any step
        ([0.0, 0.0, 0.89], False, False),
        ([0.9, 0.0, 0.0], True, True),
        ([0.95], True, True),
    ],
)
@pytest.mark.parametrize("is_success", [None, True, False])
def test_min_reward_replaces_is_success(rewards, success, at_start, is_success):
    reported = None if is_success is None else [is_success] * len(rewards)
    record = classify(episode(rewards, reported), CollectConfig(min_reward=float(np.float32(0.9))))
    assert (record.success, record.solved_at_start) == (success, at_start)
    assert record.kept == (success and not at_start)
    assert record.is_success is is_success


def test_the_record_copies_the_episode():
    record = classify(episode([0.5, 2.0, 1.0], [0, 0, 1]), CollectConfig())
    assert (record.number, record.seed, record.strength, record.length) == (3, 1_000_007, 0.5, 3)
    assert (record.max_reward, record.discrepancy, record.guidance_shift) == (2.0, 0.25, 0.75)


@pytest.mark.parametrize("keep_failures", [False, True])
def test_what_the_student_finishes_alone_is_counted_and_not_kept(keep_failures):
    alone = replace(episode([0.5, 2.0, 1.0], [0, 0, 1]), student_alone=True, student_steps=3)
    record = classify(alone, CollectConfig(keep_failures=keep_failures))
    assert record.success and not record.solved_at_start and not record.kept
    assert record.student_alone and record.student_steps == 3


def test_an_environment_that_does_not_report_success_is_refused():
    with pytest.raises(ValueError, match="is_success.*--policy.collect.min_reward"):
        classify(episode([0.0, 1.0]), CollectConfig())


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("key", ["observation.state", "action", "next.reward"])
@pytest.mark.parametrize("config", [CollectConfig(keep_failures=True), CollectConfig(min_reward=0.5)])
def test_an_episode_with_a_number_that_is_not_finite_is_dropped(key, value, config):
    valid = episode([0.0, 2.0, 1.0], [0, 0, 1])
    valid.observations["observation.state"] = np.zeros((3, 2), dtype=np.float32)
    assert classify(valid, config).kept and classify(valid, config).invalid is None
    valid.columns[key][1] = value
    record = classify(valid, config)
    assert (record.success, record.kept) == (False, False)
    assert record.invalid == f"'{key}' at step 1 is not finite"


@pytest.mark.parametrize("n_steps", [0, 1, 3])
@pytest.mark.parametrize("config", [CollectConfig(keep_failures=True), CollectConfig(min_reward=0.5)])
def test_an_episode_that_its_environment_did_not_finish_is_dropped(n_steps, config):
    stuck = replace(episode([9.0] * n_steps), problem="no answer")
    record = classify(stuck, config)
    assert record.invalid == "no answer" and record.length == n_steps
    assert not (record.success or record.kept or record.solved_at_start)
    assert record.to_json()["max_reward"] == (9.0 if n_steps else None)
