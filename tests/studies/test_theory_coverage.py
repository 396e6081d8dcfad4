"""Coverage (Lemma 3.1, Eq. 4-5): Monte Carlo, closed forms and hand-computed values."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.stats import ncx2

from lerobot_agpd.studies.theory_coverage import (
    best_coverage_bound,
    coverage_bound,
    coverage_probability,
    effective_variance,
)

# Lemma 3.1


def test_effective_variance_is_the_sampled_variance_per_axis():
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(4, 3))
    eta = 0.7 * rng.normal(size=(200_000, 3))
    states = eta @ jacobian.T + 0.5 * rng.normal(size=(200_000, 4))
    assert effective_variance(jacobian, 0.25, 0.49) == pytest.approx(states.var(axis=0).mean(), rel=0.01)


def test_the_printed_lemma_counts_the_noise_once_per_axis():
    jacobian = 2 * np.eye(3)  # s' = s + 2 a: every axis has variance 1 + 4 * 0.5
    assert effective_variance(jacobian, 1.0, 0.5) == 3.0
    assert effective_variance(jacobian, 1.0, 0.5, printed=True) == 7.0


# Coverage, Eq. 4-5


@given(
    sigma=st.floats(0.1, 2),
    sigma_test=st.floats(0.1, 2),
    epsilon=st.floats(0.05, 2),
    offset=st.floats(0.01, 3),
    dim=st.integers(1, 8),
)
@settings(deadline=None, max_examples=50)
def test_one_training_state_has_a_closed_form(sigma, sigma_test, epsilon, offset, dim):
    total = sigma**2 + sigma_test**2  # test minus training state ~ N(m, total I)
    expected = ncx2.cdf(epsilon**2 / total, dim, offset**2 / total)
    assert coverage_probability(sigma, epsilon, 1, dim, sigma_test, offset) == pytest.approx(
        expected, abs=1e-4
    )


@pytest.mark.parametrize(("dim", "sigma_test", "offset"), [(1, None, 0.0), (3, None, 0.0), (2, 0.4, 1.0)])
def test_coverage_probability_is_what_sampling_finds(dim, sigma_test, offset):
    rng = np.random.default_rng(1)
    sigma, epsilon, n, trials = 0.8, 0.3, 20, 20_000
    train = sigma * rng.normal(size=(trials, n, dim))
    test = (sigma if sigma_test is None else sigma_test) * rng.normal(size=(trials, dim))
    test[:, 0] += offset
    covered = (np.linalg.norm(train - test[:, None], axis=-1) <= epsilon).any(axis=1).mean()
    assert coverage_probability(sigma, epsilon, n, dim, sigma_test, offset) == pytest.approx(
        covered, abs=5 * 0.5 / math.sqrt(trials)
    )


def test_bound_by_hand():
    # epsilon chosen for c epsilon / sigma = 0.2; d = 2, a = 2: mass 0.04 e^-8, tail e^-2
    expected = 1 - (1 - 0.04 * math.exp(-8)) ** 1000 - math.exp(-2)
    epsilon = 0.2 * math.sqrt(2 * math.pi)
    assert coverage_bound(1.0, epsilon, 1000, 2, a=2.0) == pytest.approx(expected)


@given(st.integers(1, 30), st.floats(-3, 3), st.floats(0, 6))
@settings(deadline=None, max_examples=100)
def test_the_bound_holds_in_moderate_dimensions(dim, log10_ratio, log10_n):
    ratio, n = 10**log10_ratio, round(10**log10_n)
    assert best_coverage_bound(1.0, ratio, n, dim) <= coverage_probability(1.0, ratio, n, dim) + 1e-3


def test_the_printed_bound_fails_in_high_dimension():
    # c^d leaves out the volume of the unit ball, which is far below 1 here
    dim, n, epsilon, trials = 50, 5, 8.62, 20_000
    rng = np.random.default_rng(2)
    train, test = rng.normal(size=(trials, n, dim)), rng.normal(size=(trials, 1, dim))
    covered = (np.linalg.norm(train - test, axis=-1) <= epsilon).any(axis=1).mean()
    assert coverage_probability(1.0, epsilon, n, dim) == pytest.approx(covered, abs=0.02)
    assert best_coverage_bound(1.0, epsilon, n, dim) > covered + 0.05


def test_more_noise_covers_less_when_test_noise_grows_alike():
    sigmas = (0.2, 0.3, 0.5, 1.0)
    bounds = [best_coverage_bound(sigma, 0.3, 100, 1) for sigma in sigmas]
    truths = [coverage_probability(sigma, 0.3, 100, 1) for sigma in sigmas]
    assert bounds == pytest.approx([0.380, 0.281, 0.149, 0.0], abs=1e-3)
    assert all(np.diff(bounds) < 0) and all(np.diff(truths) < 0)


@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_coverage_of_given_test_states_peaks_at_some_noise(offset):
    sigmas = (0.01, 0.5, 10.0)
    low, middle, high = (coverage_probability(sigma, 0.1, 50, 2, 0.3, offset) for sigma in sigmas)
    assert middle > 2 * low and middle > 2 * high


@pytest.mark.parametrize(("a", "epsilon"), [(0.5, 0.1), (1.0, 10.0)])
def test_bound_refuses_what_is_no_probability(a, epsilon):
    with pytest.raises(ValueError, match=r"a >= 1 and c epsilon / sigma"):
        coverage_bound(1.0, epsilon, 10, 1, a)
