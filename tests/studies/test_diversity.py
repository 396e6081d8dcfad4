"""Entropy, coverage and divergence against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lerobot_agpd.rollout.diversity import (
    Gaussian,
    gaussian_kl,
    knn_entropy,
    match_moments,
    standardize,
    state_coverage,
)
from lerobot_agpd.studies.theory_coverage import coverage_probability


def random_covariance(rng: np.random.Generator, dim: int) -> np.ndarray:
    factor = rng.normal(size=(dim, dim))
    return factor @ factor.T + 0.1 * np.eye(dim)


def test_standardize_by_hand():
    assert standardize([[3.0, 1.0], [1.0, 1.0]], [1.0, 2.0], [2.0, 0.5]).tolist() == [
        [1.0, -2.0],
        [0.0, -2.0],
    ]
    with pytest.raises(ValueError, match=r"must be positive, not so at \[1\]"):
        standardize([[3.0, 1.0]], [0.0, 0.0], [1.0, 0.0])


@pytest.mark.parametrize("dim", [1, 2, 5])
@pytest.mark.parametrize("k", [1, 3, 10])
def test_entropy_of_a_gaussian(dim, k):
    rng = np.random.default_rng(dim)
    covariance = random_covariance(rng, dim)
    states = rng.multivariate_normal(rng.normal(size=dim), covariance, size=20_000)
    exact = 0.5 * (dim * math.log(2 * math.pi * math.e) + np.linalg.slogdet(covariance)[1])
    assert knn_entropy(states, k) == pytest.approx(exact, abs=0.06)


@given(st.floats(0.01, 100), st.integers(1, 4))
@settings(deadline=None)
def test_entropy_of_scaled_states_grows_by_the_log_of_the_scale(scale, dim):
    states = np.random.default_rng(0).normal(size=(50, dim))
    assert knn_entropy(scale * states) - knn_entropy(states) == pytest.approx(dim * math.log(scale))


def test_entropy_of_two_points_by_hand():
    # digamma(2) - digamma(1) = 1, length of [-1, 1] = 2, both neighbors 0.5 away
    assert knn_entropy([[0.0], [0.5]], k=1) == pytest.approx(1 + math.log(2) + math.log(0.5))


def test_entropy_refuses_degenerate_states():
    distinct = np.arange(4.0)[:, None]
    with pytest.raises(ValueError, match="at least k \\+ 1 = 5 states, got 4"):
        knn_entropy(distinct, k=4)
    doubled = np.concatenate([distinct, distinct[:1]])
    with pytest.raises(ValueError, match="2 of 5 states have 1 or more exact copies"):
        knn_entropy(doubled, k=1)
    assert math.isfinite(knn_entropy(doubled, k=2))
    with pytest.raises(ValueError, match="finite"):
        knn_entropy([[0.0], [math.nan]])


def test_coverage_by_hand():
    train = [[0.0, 0.0], [10.0, 0.0]]
    test = [[3.0, 4.0], [10.0, 0.0], [5.0, 0.0], [10.0, 6.0]]  # distances 5, 0, 5, 6
    assert state_coverage(test, train, 5.0) == 0.75
    assert state_coverage(test, train, 4.9) == 0.25


def test_coverage_measures_what_the_theory_computes():
    rng = np.random.default_rng(4)
    shares = [
        state_coverage(0.5 * rng.normal(size=(50, 2)) + [0.8, 0], rng.normal(size=(40, 2)), 0.2)
        for _ in range(400)
    ]
    exact = coverage_probability(1.0, 0.2, 40, 2, sigma_test=0.5, offset=0.8)
    assert np.mean(shares) == pytest.approx(exact, abs=4 * np.std(shares) / math.sqrt(len(shares)))


@pytest.mark.parametrize(
    ("test", "train", "epsilon", "message"),
    [
        (np.empty((0, 2)), np.ones((3, 2)), 1.0, "test must be a non-empty"),
        (np.ones((3, 2)), np.ones((3, 4)), 1.0, "have 2 features, training states 4"),
        (np.ones((3, 2)), np.ones((3, 2)), 0.0, "epsilon must be positive"),
    ],
)
def test_coverage_refuses_bad_input(test, train, epsilon, message):
    with pytest.raises(ValueError, match=message):
        state_coverage(test, train, epsilon)


def test_kl_by_hand():
    p = Gaussian(np.array([1.0]), np.array([[4.0]]))
    q = Gaussian(np.array([0.0]), np.array([[1.0]]))
    assert gaussian_kl(p, q) == pytest.approx(0.5 * (4 - 1 - math.log(4) + 1))
    assert gaussian_kl(q, p) == pytest.approx(0.5 * (1 / 4 - 1 + math.log(4) + 1 / 4))


@given(st.integers(1, 6), st.integers(0, 1000))
@settings(deadline=None)
def test_kl_with_explicit_matrices(dim, seed):
    rng = np.random.default_rng(seed)
    p, q = (Gaussian(rng.normal(size=dim), random_covariance(rng, dim)) for _ in range(2))
    inverse, gap = np.linalg.inv(q.covariance), p.mean - q.mean
    log_ratio = np.linalg.slogdet(q.covariance)[1] - np.linalg.slogdet(p.covariance)[1]
    exact = 0.5 * (np.trace(inverse @ p.covariance) - dim + log_ratio + gap @ inverse @ gap)
    assert gaussian_kl(p, q) == pytest.approx(exact, rel=1e-6)
    assert gaussian_kl(p, q) > 0 and gaussian_kl(p, p) == pytest.approx(0, abs=1e-9)


def test_shrinkage_keeps_the_trace_and_makes_few_samples_regular():
    samples = np.random.default_rng(5).normal(size=(4, 10))
    plain, shrunk = match_moments(samples, 0.0), match_moments(samples, 0.2)
    assert np.trace(shrunk.covariance) == pytest.approx(np.trace(plain.covariance))
    scale = np.trace(plain.covariance) / 10
    assert np.linalg.eigvalsh(shrunk.covariance)[0] == pytest.approx(0.2 * scale)
    with pytest.raises(ValueError, match="covariance of p is singular"):
        gaussian_kl(plain, shrunk)
    assert math.isfinite(gaussian_kl(shrunk, shrunk))


@pytest.mark.parametrize(
    ("samples", "message"), [(np.ones((5, 3)), "all samples are equal"), (np.ones((1, 3)), "at least 2")]
)
def test_samples_without_a_density_are_refused(samples, message):
    with pytest.raises(ValueError, match=message):
        match_moments(samples)
