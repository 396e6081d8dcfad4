"""Intervals, against hand-computed values and by their coverage."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import t

from lerobot_agpd.studies.statistics import mean, paired_difference, success_rate


def test_wilson_interval_of_eight_in_ten():
    estimate = success_rate([True] * 8 + [False] * 2)
    z, n, p = 1.959964, 10, 0.8
    center = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert estimate.mean == 0.8 and estimate.n == 10
    assert (estimate.low, estimate.high) == pytest.approx((center - half, center + half), abs=1e-6)


def test_mean_of_three_values():
    estimate = mean([1.0, 2.0, 3.0])
    half = t.ppf(0.975, 2) * 1 / np.sqrt(3)
    assert (estimate.mean, estimate.low, estimate.high) == pytest.approx((2, 2 - half, 2 + half))


def test_nothing_to_estimate_is_refused():
    with pytest.raises(ValueError, match="at least one"):
        success_rate([])
    with pytest.raises(ValueError, match="at least two"):
        mean([1.0])


def test_paired_difference_by_hand():
    """Differences [[1, 3], [4, 10]]: mean 4.5; row means 2, 7; column means 2.5, 6.5.

    MS_seed = 2 (2.5^2 + 2.5^2) / 1 = 25, MS_environment = 2 (2^2 + 2^2) / 1 = 16; the four residuals are +-1, so
    MS_rest = 4 / 1 = 4. Variance = (25 + 12) / 4; degrees of freedom 37^2 / (25^2 + 16^2 + 4^2).
    """
    difference = paired_difference([[1, 3], [4, 10]], np.zeros((2, 2)))
    half = t.ppf(0.975, 37**2 / (25**2 + 16**2 + 4**2)) * np.sqrt(37 / 4)
    assert (difference.mean, difference.low, difference.high) == pytest.approx((4.5, 4.5 - half, 4.5 + half))
    assert (difference.n_seeds, difference.n_environments) == (2, 2)


def test_one_training_seed_is_a_paired_t_interval_over_environments():
    first, second = np.array([[1.0, 0, 1, 1]]), np.array([[0.0, 0, 1, 0]])
    difference = paired_difference(first, second)
    half = t.ppf(0.975, 3) * np.std([1, 0, 0, 1], ddof=1) / 2
    assert (difference.mean, difference.low, difference.high) == pytest.approx((0.5, 0.5 - half, 0.5 + half))


def test_a_difference_in_every_pair_is_certain():
    difference = paired_difference(np.ones((3, 5)), np.zeros((3, 5)))
    assert (difference.low, difference.mean, difference.high) == (1, 1, 1)
    assert difference.excludes_zero and str(difference) == "+1.00 [+1.00, +1.00]"


def test_wrong_shapes_are_refused():
    for shapes in (((2, 3), (3, 3)), ((4,), (4,)), ((2, 1), (2, 1))):
        with pytest.raises(ValueError, match="training seeds, environments"):
            paired_difference(*(np.zeros(shape) for shape in shapes))


@settings(deadline=None, max_examples=50)
@given(arrays(float, (3, 4), elements=st.integers(0, 1).map(float)), st.permutations([0, 1, 2]))
def test_swapping_sides_flips_the_interval_and_order_does_not_matter(first, order):
    second = first[::-1, ::-1]
    one, other = paired_difference(first, second), paired_difference(second, first)
    assert (one.mean, one.low, one.high) == pytest.approx((-other.mean, -other.high, -other.low))
    reordered = paired_difference(first[order], second[order])
    assert (reordered.low, reordered.high) == pytest.approx((one.low, one.high))


@pytest.mark.parametrize(("seed_std", "env_std"), [(0.0, 0.2), (0.02, 0.2), (0.05, 0.0), (0.1, 0.2)])
def test_three_training_seeds_cover_the_truth(seed_std, env_std):
    """At least 92 % of 400 intervals hold the true difference, whatever the seeds contribute (95 % nominal)."""
    rng = np.random.default_rng(0)
    zeros, hits = np.zeros((3, 200)), 0
    for _ in range(400):
        noise = [rng.standard_normal(shape) for shape in ((3, 1), (1, 200), (3, 200))]
        values = 0.1 + seed_std * noise[0] + env_std * noise[1] + 0.45 * noise[2]
        difference = paired_difference(values, zeros)
        hits += difference.low <= 0.1 <= difference.high
    assert hits / 400 >= 0.92
