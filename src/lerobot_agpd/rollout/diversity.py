"""Measures of diversity: entropy and coverage of states, divergence of Gaussians over actions.

Features are numpy arrays, one row per state or action. Entropy and coverage depend on the features' units:
standardize every set that is compared with the *same* statistics, best those of the demonstrations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial import cKDTree
from scipy.special import digamma, gammaln

Array = NDArray[np.floating]


def standardize(features: ArrayLike, mean: ArrayLike, std: ArrayLike) -> Array:
    """Compute (features - mean) / std with given statistics.

    Args:
        features: (N, D).
        mean: (D,).
        std: (D,), positive. Leave out features that never vary, or give them a floor.

    Raises:
        ValueError: for non-finite values, or a standard deviation that is not positive.
    """
    spread = np.asarray(std, dtype=float)
    if not np.all(spread > 0):
        raise ValueError(
            f"standard deviations must be positive, not so at {np.flatnonzero(~(spread > 0)).tolist()}"
        )
    return (_points(features, "features") - np.asarray(mean, dtype=float)) / spread


def knn_entropy(states: ArrayLike, k: int = 3) -> float:
    """Estimate differential entropy in nats from k-nearest-neighbor distances.

    Kozachenko and Leonenko (1987): h = digamma(N) - digamma(k) + log V_D + D / N sum log r, with r the Euclidean
    distance to the k-th other point and V_D the volume of the unit ball. It assumes independent points: states of one
    episode are not, so compare sets of equal N and equal episode lengths, and read differences, not values.

    Args:
        states: (N, D) independent points, standardized.
        k: which neighbor.

    Raises:
        ValueError: for fewer than k + 1 points, or if a point has k exact copies, where the entropy is -inf.
    """
    points = _points(states, "states")
    n, dim = points.shape
    if k < 1 or n < k + 1:
        raise ValueError(f"the {k}-th neighbor needs k >= 1 and at least k + 1 = {k + 1} states, got {n}")
    radii = cKDTree(points).query(points, k=[k + 1])[0][:, 0]  # the nearest is the point itself
    n_repeated = int(np.sum(radii == 0))
    if n_repeated:
        raise ValueError(
            f"{n_repeated} of {n} states have {k} or more exact copies: no density there. Drop repeated states, or "
            "features that are discrete, or raise k"
        )
    log_ball = dim / 2 * math.log(math.pi) - gammaln(dim / 2 + 1)
    return float(digamma(n) - digamma(k) + log_ball + dim * np.mean(np.log(radii)))


def state_coverage(test: ArrayLike, train: ArrayLike, epsilon: float) -> float:
    """Measure the next-state coverage P_S: the fraction of test states with a training state within epsilon.

    The quantity that Eq. 4-5 bound (Belkhale et al. 2023, arXiv:2306.02437), over all visited states rather than the
    successors of one.

    Args:
        test: (N, D) states of the student's own rollouts, standardized.
        train: (M, D) states in the training data, standardized alike.
        epsilon: largest Euclidean distance that counts, in standard deviations; it may be met exactly.

    Raises:
        ValueError: for empty sets, or sets of different dimension.
    """
    queries, points = _points(test, "test"), _points(train, "train")
    if queries.shape[1] != points.shape[1]:
        raise ValueError(f"test states have {queries.shape[1]} features, training states {points.shape[1]}")
    if epsilon <= 0:
        raise ValueError(f"epsilon must be positive, got {epsilon}")
    return float(np.mean(cKDTree(points).query(queries)[0] <= epsilon))


@dataclass(frozen=True)
class Gaussian:
    """Mean (D,) and covariance (D, D)."""

    mean: Array
    covariance: Array


def match_moments(samples: ArrayLike, shrinkage: float = 0.1) -> Gaussian:
    """Fit a Gaussian with the samples' mean and shrunk covariance.

    The covariance becomes (1 - shrinkage) S + shrinkage (tr S / D) I, because S of N <= D samples is singular. The
    trace, the total variance, is kept. Use the same shrinkage for everything that is compared.

    Args:
        samples: (N, D) repeated actions, or flattened chunks, at one observation.
        shrinkage: in [0, 1]; 0 keeps S.

    Raises:
        ValueError: for fewer than two samples, or samples that are all equal.
    """
    points = _points(samples, "samples")
    if len(points) < 2 or not 0 <= shrinkage <= 1:
        raise ValueError(
            f"need at least 2 samples and shrinkage in [0, 1], got {len(points)} and {shrinkage}"
        )
    if not np.any(np.ptp(points, axis=0)):
        raise ValueError("all samples are equal: a deterministic policy has no density and no KL divergence")
    dim = points.shape[1]
    covariance = np.atleast_2d(np.cov(points, rowvar=False))
    scale = np.trace(covariance) / dim
    return Gaussian(points.mean(axis=0), (1 - shrinkage) * covariance + shrinkage * scale * np.eye(dim))


def gaussian_kl(p: Gaussian, q: Gaussian) -> float:
    """Compute KL(p || q) in nats (Eq. 14).

    Raises:
        ValueError: if either covariance is singular.
    """
    factor_p, factor_q = _cholesky(p.covariance, "p"), _cholesky(q.covariance, "q")
    gap = p.mean - q.mean
    log_ratio = 2 * np.sum(np.log(np.diag(factor_q)) - np.log(np.diag(factor_p)))  # ln |Sigma_q| / |Sigma_p|
    trace = np.trace(cho_solve((factor_q, True), p.covariance))
    return float(0.5 * (trace - len(gap) + log_ratio + gap @ cho_solve((factor_q, True), gap)))


def _points(values: ArrayLike, name: str) -> Array:
    points = np.asarray(values, dtype=float)
    if points.ndim != 2 or points.size == 0 or not np.all(np.isfinite(points)):
        raise ValueError(f"{name} must be a non-empty finite array (N, D), got shape {points.shape}")
    return points


def _cholesky(covariance: Array, name: str) -> Array:
    """Lower Cholesky factor; numerically singular matrices are refused."""
    try:
        factor = cho_factor(covariance, lower=True)[0]
    except LinAlgError:
        factor = np.zeros_like(covariance)
    diagonal = np.diag(factor)
    if diagonal.min() <= 1e-7 * diagonal.max():
        raise ValueError(
            f"the covariance of {name} is singular: give match_moments a positive shrinkage or more samples"
        )
    return factor
