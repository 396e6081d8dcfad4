"""Several ways: closed forms by hand, against sampling, and against rounds of finitely many episodes."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.special import expit

from lerobot_agpd.studies.theory_ways import (
    balance_threshold,
    coupling,
    effective_scale,
    escape_probability,
    guided_agreement,
    mean_fixed_points,
    mean_map,
    mean_student,
    median_student,
    median_threshold_two_ways,
    mixed_mean,
    nearest_agreement,
    nearest_agrees_in_all,
    next_shares,
    samples_needed,
    share_after_choosing,
    side_threshold,
    simulate_rounds,
    stuck_share,
    tilted_shares,
)

TWO = np.array([[1.0], [-1.0]])
ANGLES = 2 * np.pi * np.arange(3) / 3
THREE = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)


def test_tilt_of_two_ways_by_hand():
    """Student at 0.5, ways at 1 and -1: J = 1/8 and 9/8; k = 2, spread 1: k' = 2/3, log-odds log(1/3) + 2/3."""
    assert effective_scale(2.0, 1.0) == pytest.approx(2 / 3)
    shares = tilted_shares([0.25, 0.75], TWO, [0.5], 2.0, 1.0)
    assert shares[0] == pytest.approx(expit(math.log(1 / 3) + 2 / 3))
    assert coupling(2.0, 0.0, 2.0) == 4.0


@pytest.mark.parametrize("k", [0.0, 0.7, 3.0])
def test_tilt_is_what_reweighted_samples_say(k):
    """Importance sampling of the mixture itself: shares, and the moments within a way."""
    rng, n, spread, student = np.random.default_rng(0), 400_000, 0.6, np.array([0.2, 0.3])
    weights = np.array([0.5, 0.2, 0.3])
    way = rng.choice(3, n, p=weights)
    actions = THREE[way] + spread * rng.standard_normal((n, 2))
    tilt = np.exp(-k * 0.5 * np.square(actions - student).sum(axis=1))
    empirical = np.bincount(way, tilt) / tilt.sum()
    np.testing.assert_allclose(tilted_shares(weights, THREE, student, k, spread), empirical, atol=0.006)


@given(st.floats(0.05, 0.95), st.floats(0.01, 8), st.floats(0, 1))
def test_mean_map_is_the_feedback_map(share, k, spread):
    kappa = coupling(k, spread, 2.0)
    assert mean_map(share, kappa) == pytest.approx(expit(kappa * (2 * share - 1)))
    assert next_shares([share, 1 - share], TWO, k, spread, mean_student)[0] == pytest.approx(
        mean_map(share, kappa)
    )
    rest = (1 - share) / 2
    of_three = next_shares([share, rest, rest], THREE, k, spread, mean_student)
    assert of_three[0] == pytest.approx(mean_map(share, coupling(k, spread, math.sqrt(3)), 3))


@pytest.mark.parametrize("n_ways", [2, 3, 5])
def test_slope_of_the_balanced_state(n_ways):
    for kappa in (0.5, balance_threshold(n_ways), 7.0):
        step = 1e-5
        slope = (mean_map(1 / n_ways + step, kappa, n_ways) - mean_map(1 / n_ways - step, kappa, n_ways)) / (
            2 * step
        )
        assert slope == pytest.approx(kappa / balance_threshold(n_ways), rel=1e-4)


def test_fixed_points():
    assert mean_fixed_points(1.9) == [0.5]
    _, side = mean_fixed_points(2.2)
    assert 0.5 < side < 1 and side == pytest.approx(mean_map(side, 2.2))
    assert mean_fixed_points(2.7, 3) == [1 / 3]
    assert len(mean_fixed_points(2.9, 3)) == 3, "balanced, an unstable one between, one side"
    assert len(mean_fixed_points(3.1, 3)) == 2
    assert side_threshold(2) == 2.0 and side_threshold(3) == pytest.approx(2.7456, abs=2e-3)


def test_median_of_ways():
    assert median_student(np.array([0.6, 0.4]), TWO).tolist() == [1.0]
    assert median_student(np.array([0.5, 0.5]), TWO).tolist() == [0.0]
    np.testing.assert_allclose(median_student(np.full(3, 1 / 3), THREE), [-0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(median_student(np.array([0.2, 0.6, 0.2]), THREE), THREE[1], atol=1e-12)


@given(st.floats(0.0, 20.0))
def test_a_median_student_of_three_ways_stays_between_two_of_them(kappa):
    k = 2 * kappa / 3  # distance^2 = 3, no spread
    shares = next_shares(np.full(3, 1 / 3), THREE, k, 0.0, median_student)
    assert shares[1] == pytest.approx(stuck_share(kappa)) and shares[1] == pytest.approx(shares[2])
    assert shares[1] < 0.5


def test_median_threshold_is_where_the_slope_is_one():
    distance, spread, step = 2.0, 0.6, 1e-4
    threshold = median_threshold_two_ways(distance, spread)
    k_prime = threshold / distance**2
    points = np.linspace(-0.2, 0.2, 400_001)
    from scipy.stats import norm

    def median(share):
        below = share * norm.cdf((points - 1) / spread) + (1 - share) * norm.cdf((points + 1) / spread)
        return np.interp(0.5, below, points)

    slope = (expit(2 * k_prime * median(0.5 + step)) - expit(2 * k_prime * median(0.5 - step))) / (2 * step)
    assert slope == pytest.approx(1, rel=1e-3)
    assert median_threshold_two_ways(2.0, 0.01) == 0 < median_threshold_two_ways(2.0, 0.3) < threshold


def test_escape_by_hand():
    """One episode: it always takes a way, the two nearer ones with 2 p."""
    assert escape_probability(1.0, 1) == pytest.approx(2 * stuck_share(1.0))
    p = stuck_share(1.0)
    assert escape_probability(1.0, 3) == pytest.approx(2 * (3 * p**2 * (1 - p) + p**3))


def test_mixing_goes_back_to_the_middle():
    position = 1.0
    for _ in range(20):
        position = mixed_mean(position, 0.3)
    assert abs(position) < 1e-9
    assert share_after_choosing(0.5, 0.3) == pytest.approx(0.65)


def test_nearest_by_hand_and_by_sampling():
    assert nearest_agrees_in_all(1, 3) == pytest.approx(1 / 8)
    assert nearest_agrees_in_all(2, 1) == pytest.approx(3 / 4)
    assert nearest_agreement(1, 4) == pytest.approx(0.5)
    assert nearest_agreement(2, 1) == pytest.approx(3 / 4)
    matches = np.random.default_rng(0).binomial(6, 0.5, (100_000, 8)).max(axis=1)
    assert nearest_agreement(8, 6) == pytest.approx(matches.mean() / 6, abs=0.003)
    assert nearest_agrees_in_all(8, 6) == pytest.approx((matches == 6).mean(), abs=0.005)


@given(st.floats(0.05, 0.99), st.integers(1, 12))
def test_samples_needed_is_the_least_number(probability, n_choices):
    n = samples_needed(probability, n_choices)
    assert nearest_agrees_in_all(n, n_choices) >= probability - 1e-12
    assert n == 1 or nearest_agrees_in_all(n - 1, n_choices) < probability


def test_guidance_agrees_as_often_with_many_choices_as_with_one():
    """Many choices in one chunk, tilted together: every choice has the log-odds of its own J."""
    kappa, n = coupling(1.5, 0.3, 2.0), 3
    chunks = np.array(np.meshgrid(*[[1.0, -1.0]] * n)).reshape(n, -1).T
    shares = tilted_shares(np.full(2**n, 2.0**-n), chunks, np.ones(n), 1.5, 0.3)
    assert shares @ (chunks == 1).mean(axis=1) == pytest.approx(guided_agreement(kappa))
    assert shares[(chunks == 1).all(axis=1)] == pytest.approx(guided_agreement(kappa) ** n)


@pytest.mark.parametrize(("scale", "leaves"), [(0.5, False), (2.0, True)])
def test_rounds_stay_in_the_middle_below_the_threshold_and_leave_it_above(scale, leaves):
    """k distance^2 = 2 and 8, around the threshold of 4."""
    rng, runs = np.random.default_rng(1), 40
    last = np.array(
        [simulate_rounds(rng, TWO, scale, 0.05, False, [10, 10], 200, 15)[-1, 0] for _ in range(runs)]
    )
    lead = np.maximum(last, 1 - last).mean()
    expected = mean_fixed_points(coupling(scale, 0.05, 2.0))[-1]
    assert (expected > 0.9) == leaves
    assert lead == pytest.approx(expected, abs=0.07)
