"""How likely the next state at test time is close to one in the data: Lemma 3.1 and Eq. 4-5 of the paper.

As printed, and with the slips repaired; `docs/theory.md` tells what comes out.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import roots_legendre
from scipy.stats import chi2, ncx2

GAUSSIAN_C = 1 / math.sqrt(2 * math.pi)
"""The constant c of Eq. 4, after appendix B.2."""


def effective_variance(
    jacobian: ArrayLike, var_state: float, var_action: float, printed: bool = False
) -> float:
    """Variance per axis of the next state when the action is noisy (Lemma 3.1).

    s' ~ N(mu(s, a + eta), var_state I) with eta ~ N(0, var_action I), to first order in eta. The lemma prints
    var_state + ||G||_F^2 var_action; its own proof has ||G||_F^2 / S, the trace over the S axes, and drops the S.

    Args:
        jacobian: G = d mu / d a, (S, A).
        var_state: variance of the system noise.
        var_action: variance of the policy noise.
        printed: without the division by S.
    """
    gradient = np.asarray(jacobian, dtype=float)
    gain = float(np.square(gradient).sum())
    return var_state + var_action * (gain if printed else gain / len(gradient))


def coverage_bound(
    sigma: float, epsilon: float, n: int, dim: int, a: float | NDArray[np.floating]
) -> NDArray[np.floating]:
    """Lower bound on the next-state coverage P_S, as printed in Eq. 4; with sigma_eff it is Eq. 5.

    1 - [1 - (c epsilon / sigma)^d exp(-a^2 d)]^n - exp(-(a - 1)^2 d). `a` is a free parameter >= 1 (appendix B.2),
    not the action. Below 0 the bound says nothing.

    Raises:
        ValueError: for a < 1, and where (c epsilon / sigma)^d exp(-a^2 d), which stands for a probability, exceeds 1.
    """
    a = np.asarray(a, dtype=float)
    log_mass = dim * (math.log(GAUSSIAN_C * epsilon / sigma) - a**2)
    if np.any(a < 1) or np.any(log_mass > 0):
        raise ValueError(
            f"Eq. 4 needs a >= 1 and c epsilon / sigma <= exp(a^2), got a = {a.min():.3g} and "
            f"c epsilon / sigma = {GAUSSIAN_C * epsilon / sigma:.3g}"
        )
    with np.errstate(divide="ignore"):  # a mass of 1 is a sure hit: log(0), exp(-inf) = 0
        log_miss = n * np.log1p(-np.exp(log_mass))
    return -np.expm1(log_miss) - np.exp(-dim * (a - 1) ** 2)


def best_coverage_bound(sigma: float, epsilon: float, n: int, dim: int) -> float:
    """Eq. 4 at the `a` that makes it largest, searched on 2,000 points of [1, 1 + 6 / sqrt(dim)]."""
    a = 1 + np.linspace(0, 6 / math.sqrt(dim), 2001)
    a = a[np.log(GAUSSIAN_C * epsilon / sigma) <= a**2]
    return float(coverage_bound(sigma, epsilon, n, dim, a).max()) if a.size else -math.inf


def coverage_probability(
    sigma: float, epsilon: float, n: int, dim: int, sigma_test: float | None = None, offset: float = 0.0
) -> float:
    """P_S itself: the chance that a test state has one of n training states within epsilon.

    Training states are N(0, sigma^2 I), test states N(m, sigma_test^2 I) with ||m|| = offset. Given the test state's
    distance from 0, a training state's squared distance to it is noncentral chi-square; the average over test
    states is a Gauss-Legendre sum over 200 quantiles.

    Args:
        sigma: standard deviation of the training states.
        epsilon: largest distance that counts as covered.
        n: number of training states.
        dim: dimension of the state.
        sigma_test: standard deviation of the test states; None is the same as in training, as in Eq. 4.
        offset: distance between the two centers.
    """
    sigma_test = sigma if sigma_test is None else sigma_test
    nodes, weights = roots_legendre(200)
    quantiles = (nodes + 1) / 2
    if offset == 0:
        distance_sq = sigma_test**2 * chi2.ppf(quantiles, dim)
    else:
        distance_sq = sigma_test**2 * ncx2.ppf(quantiles, dim, (offset / sigma_test) ** 2)
    hit = ncx2.cdf((epsilon / sigma) ** 2, dim, distance_sq / sigma**2)
    with np.errstate(divide="ignore"):
        covered = -np.expm1(n * np.log1p(-np.minimum(hit, 1.0)))
    return float(np.sum(weights * covered) / 2)
