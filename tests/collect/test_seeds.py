import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.stats import kstest

from lerobot_agpd.collect.config import COLLECTION_SEEDS, EVALUATION_SEEDS
from lerobot_agpd.collect.seeds import failed_starts, noise_seed, round_tickets, share_of


def tickets(n=50, seed=1000, rank=0, number=0, scale=2.0, fraction=0.2, n_ranks=1):
    return round_tickets(n, seed, rank, n_ranks, number, scale, fraction)


def test_reproducible():
    assert tickets() == tickets()
    assert [t.seed for t in tickets(scale=9.0)] == [t.seed for t in tickets()]
    assert [ticket.number for ticket in tickets()] == list(range(50))


def test_disjoint_between_ranks_rounds_and_seeds():
    drawn = [
        ticket.seed
        for seed in (0, 1000)
        for rank in range(4)
        for number in range(20)
        for ticket in tickets(n=40, seed=seed, rank=rank, number=number, n_ranks=4)
    ]
    assert len(drawn) == 1600 == len(set(drawn))
    noise = [noise_seed(s, r, n) for s in (0, 1000) for r in range(4) for n in range(20)]
    assert len(noise) == len(set(noise)) and noise_seed(0, 1, 2) == noise_seed(0, 1, 2)


@given(st.integers(0, 2**32 - 1), st.integers(0, 8), st.integers(0, 1000))
def test_property_seeds_never_meet_evaluations(seed, rank, number):
    low, high = COLLECTION_SEEDS
    assert all(low <= ticket.seed < high for ticket in tickets(180, seed, rank, number, n_ranks=9))
    assert low == EVALUATION_SEEDS[1] == 1_000_000


@pytest.mark.parametrize(
    ("n", "fraction", "expected"),
    [(50, 0.2, 10), (10, 0.3, 3), (7, 0.5, 3), (5, 0.0, 0), (5, 1.0, 5), (50, 0.1, 5), (100, 0.29, 29)],
)
def test_number_of_unguided_episodes(n, fraction, expected):
    drawn = tickets(n, fraction=fraction)
    unguided = [ticket for ticket in drawn if not ticket.guided]
    assert len(unguided) == expected
    assert all(ticket.scale == 0 for ticket in unguided)
    assert all(ticket.scale == 2.0 for ticket in drawn if ticket.guided)


@given(st.integers(1, 200), st.floats(0, 1))
def test_property_unguided_episodes_are_spread_evenly(n, fraction):
    """Every leading part of the round holds its share, to within one episode."""
    count = 0
    for seen, ticket in enumerate(tickets(n, fraction=fraction), start=1):
        count += not ticket.guided
        assert abs(count - seen * fraction) <= 1 + 1e-6


@pytest.mark.parametrize(("episodes", "n_ranks"), [(50, 1), (16, 4), (12, 8)])
def test_unguided_share_survives_being_split_over_processes(episodes, n_ranks):
    """A round of 16 episodes with a fifth unguided holds about 3 unguided ones, on 4 processes too."""
    drawn = [
        t for rank in range(n_ranks) for t in tickets(episodes, rank=rank, fraction=0.2, n_ranks=n_ranks)
    ]
    assert len(drawn) == episodes
    unguided = sum(not ticket.guided for ticket in drawn)
    assert abs(unguided - 0.2 * episodes) <= 1


@given(st.integers(0, 500), st.integers(1, 16))
def test_property_shares_add_up(n, n_ranks):
    shares = [share_of(n, rank, n_ranks) for rank in range(n_ranks)]
    assert sum(shares) == n and max(shares) - min(shares) <= 1


def varied(n=2000, scale=2.0, **options):
    return round_tickets(n, 1000, 0, 1, 0, scale, 0.2, **options)


def test_without_variation_nothing_varies():
    assert all(ticket.scale in (0.0, 2.0) and ticket.student_share == 0 for ticket in varied())


def test_scales_are_log_uniform_around_the_rounds():
    drawn = varied(scale_spread=3.0)
    spread = np.log([ticket.scale / 2.0 for ticket in drawn if ticket.guided]) / np.log(3.0)
    assert len(spread) == 1600 and all(ticket.scale == 0 for ticket in drawn if not ticket.guided)
    assert kstest(spread, "uniform", args=(-1, 2)).pvalue > 0.01
    assert [t.seed for t in drawn] == [t.seed for t in varied()]


def test_students_shares_are_uniform_with_and_without_guidance():
    drawn = varied(max_student_share=0.6)
    for guided in (True, False):
        shares = [ticket.student_share / 0.6 for ticket in drawn if ticket.guided is guided]
        assert kstest(shares, "uniform").pvalue > 0.01


def test_variation_belongs_to_the_ticket():
    """It hangs on the ticket's own seed: neither on the rest of the round nor on the guidance scale."""
    options = {"scale_spread": 3.0, "max_student_share": 0.5}
    small, large = varied(5, scale=1.0, **options), varied(50, scale=8.0, **options)
    for ours, theirs in zip(small, large, strict=False):
        assert ours.student_share == theirs.student_share
        assert 8 * ours.scale == pytest.approx(theirs.scale)
    assert varied(50, scale=8.0, **options) == large


def entry(seed, passed=False, trivial=False):
    return {"seed": seed, "passed": passed, "trivial": trivial}


def test_failed_starts_by_hand():
    """3 was solved at the second attempt, 4 is solved from the start, 2 was tried twice and comes last."""
    reports = [
        {"episodes": [entry(1, passed=True), entry(2), entry(3), entry(4, trivial=True)]},
        {"episodes": [entry(2), entry(3, passed=True), entry(5)]},
        {"episodes": [entry(6)]},
    ]
    assert failed_starts(reports) == [5, 6, 2]
    assert failed_starts([]) == []


def test_retries_take_the_first_places_of_the_strategy():
    fresh, again = varied(10), varied(10, retries=[7, 8, 9])
    assert [ticket.seed for ticket in again if ticket.retry] == [7, 8, 9]
    for before, after in zip(fresh, again, strict=True):
        assert (after.number, after.scale) == (before.number, before.scale)
        assert after.retry or after == before
        assert after.guided or not after.retry
    assert (
        sum(ticket.retry for ticket in varied(10, retries=range(50))) == 8
    )  # the unguided fifth keeps its starts


def test_a_retry_is_varied_anew_in_every_round():
    options = {"scale_spread": 3.0, "max_student_share": 0.5, "retries": [7]}
    first, second = (round_tickets(5, 1000, 0, 1, number, 2.0, 0.2, **options)[0] for number in (1, 2))
    assert first.seed == second.seed == 7
    assert first.scale != second.scale and first.student_share != second.student_share
