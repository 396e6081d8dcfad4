import pytest
from hypothesis import given, strategies as st
from scipy.stats import kstest

from lerobot_agpd.config import COLLECTION_SEEDS, EVALUATION_SEEDS
from lerobot_agpd.replay.episode import EpisodeRecord
from lerobot_agpd.rollout.seeds import (
    DIAGNOSTICS_STREAM,
    ROLLIN_FRACTION,
    STUDENT_NOISE_STREAM,
    TEACHER_NOISE_STREAM,
    episode_specs,
    failed_starts,
    rank_part,
    stream_seed,
)

STREAMS = (TEACHER_NOISE_STREAM, STUDENT_NOISE_STREAM, DIAGNOSTICS_STREAM)


def specs(n=50, seed=1000, round_number=0, strength=2.0, fraction=0.2, **options):
    return episode_specs(n, seed, round_number, strength, fraction, **options)


def test_reproducible():
    assert specs() == specs()
    assert [spec.seed for spec in specs(strength=9.0)] == [spec.seed for spec in specs()]
    assert [spec.number for spec in specs()] == list(range(50))
    assert all(spec.strength in (0.0, 2.0) and spec.student_fraction == 0 for spec in specs())


def test_the_seeds_of_runs_of_one_process_stay():
    """Golden values: a killed run that goes on with a later version must find the episodes it was collecting."""
    assert [spec.seed for spec in specs(n=3)] == [438281551, 1120145960, 1822122400]
    assert [spec.seed for spec in specs(n=3, round_number=1)] == [1138602123, 669158437, 1953699071]


def test_disjoint_between_rounds_and_runs_and_noise_between_processes():
    rounds = [(seed, number) for seed in (0, 1000) for number in range(20)]
    drawn = [spec.seed for seed, number in rounds for spec in specs(n=40, seed=seed, round_number=number)]
    assert len(drawn) == 1600 == len(set(drawn))
    runs = [(seed, rank, number) for seed in (0, 1000) for rank in range(4) for number in range(20)]
    noise = {stream_seed(*run, stream) for run in runs for stream in STREAMS}
    assert len(noise) == len(runs) * len(STREAMS) and stream_seed(0, 1, 2, 3) == stream_seed(0, 1, 2, 3)


@given(st.integers(0, 2**32 - 1), st.integers(0, 1000))
def test_seeds_are_never_those_of_evaluations(seed, round_number):
    low, high = COLLECTION_SEEDS
    drawn = specs(20, seed, round_number)
    assert all(low <= spec.seed < high for spec in drawn)
    assert low == EVALUATION_SEEDS[1] == 1_000_000


@pytest.mark.parametrize(
    ("n", "fraction", "expected"),
    [(50, 0.2, 10), (10, 0.3, 3), (7, 0.5, 3), (5, 0.0, 0), (5, 1.0, 5), (50, 0.1, 5), (100, 0.29, 29)],
)
def test_number_of_teacher_only_episodes(n, fraction, expected):
    drawn = specs(n, fraction=fraction)
    assert sum(spec.teacher_only for spec in drawn) == expected
    assert all(spec.strength == (0.0 if spec.teacher_only else 2.0) for spec in drawn)


@given(st.integers(1, 200), st.floats(0, 1))
def test_teacher_only_episodes_are_spread_evenly(n, fraction):
    """Every leading part of the round holds its fraction, to within one episode."""
    count = 0
    for seen, spec in enumerate(specs(n, fraction=fraction), start=1):
        count += spec.teacher_only
        assert abs(count - seen * fraction) <= 1 + 1e-6


@given(st.integers(0, 60), st.integers(1, 16), st.sets(st.integers(0, 59)))
def test_parts_of_the_processes_are_the_missing_episodes(n, n_ranks, done):
    """Each in one part, whatever is done already; the parts are equal, to within one episode."""
    drawn = specs(n)
    parts = [rank_part(drawn, done, rank, n_ranks) for rank in range(n_ranks)]
    assert [spec for part in parts for spec in part] == [spec for spec in drawn if spec.number not in done]
    sizes = [len(part) for part in parts]
    assert max(sizes) - min(sizes) <= 1


def test_parts_by_hand():
    numbers = [[spec.number for spec in rank_part(specs(7), {1, 5}, rank, 2)] for rank in range(2)]
    assert numbers == [[0, 2, 3], [4, 6]]


def test_students_fractions_are_uniform_with_and_without_guidance():
    drawn = specs(2000, student_begins=True)
    for teacher_only in (True, False):
        fractions = [
            spec.student_fraction / ROLLIN_FRACTION for spec in drawn if spec.teacher_only is teacher_only
        ]
        assert kstest(fractions, "uniform").pvalue > 0.01


def test_a_students_fraction_hangs_on_the_episodes_own_seed():
    """Neither on the rest of the round nor on the strength."""
    small, large = specs(5, student_begins=True), specs(50, strength=8.0, student_begins=True)
    assert [spec.student_fraction for spec in small] == [spec.student_fraction for spec in large[:5]]


def record(seed, success=False, solved_at_start=False, **options) -> EpisodeRecord:
    facts = {"strength": 0.0, "length": 1, "max_reward": 0.0, "is_success": None, "kept": success, **options}
    return EpisodeRecord(number=0, seed=seed, success=success, solved_at_start=solved_at_start, **facts)


def test_failed_starts_by_hand():
    """3 was solved at the second attempt, 4 is solved from the start, 2 was tried twice and comes last."""
    first = [record(1, success=True), record(2), record(3), record(4, solved_at_start=True)]
    second = [record(2), record(3, success=True), record(5)]
    assert failed_starts([*first, *second, record(6)]) == [5, 6, 2]
    assert failed_starts([]) == []
    assert failed_starts([record(1, invalid="'action' at step 0")]) == [], "the environment failed there"


def test_retries_take_the_first_places_of_the_strategy():
    fresh, again = specs(10), specs(10, retries=[7, 8, 9])
    assert [spec.seed for spec in again if spec.retry] == [7, 8, 9]
    for before, after in zip(fresh, again, strict=True):
        assert (after.number, after.strength) == (before.number, before.strength)
        assert after.retry or after == before
        assert not (after.teacher_only and after.retry)
    assert sum(spec.retry for spec in specs(10, retries=range(50))) == 8  # the teacher-only fifth is new


def test_a_retry_is_varied_anew_in_every_round():
    options = {"student_begins": True, "retries": [7]}
    first, second = (specs(5, round_number=number, **options)[0] for number in (1, 2))
    assert first.seed == second.seed == 7
    assert first.student_fraction != second.student_fraction
