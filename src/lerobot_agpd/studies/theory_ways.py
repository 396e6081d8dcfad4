"""A teacher that knows several ways, and a deterministic student: which way the data of the next rounds take.

At one observation the teacher acts as a mixture of ways, sum_i w_i N(m_i, spread^2 I). A student that answers with one
action a stands at the mean (squared error) or the median (absolute error) of the data. Guidance tilts the teacher by
exp(-k J) with J = 1/2 ||action - a||^2, its actions become the next data, and so on. `docs/theory.md` tells what comes out.

The *coupling* of ways that are all `distance` apart is kappa = k' distance^2 / 2, where k' = k / (1 + k spread^2).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import expit, softmax
from scipy.stats import binom, norm

Array = NDArray[Any]
StudentRule = Callable[[Array, Array], Array]
"""Where a student stands, (D,), for data with shares (n,) of the ways (n, D)."""


# ---- tilting a mixture ----


def effective_scale(k: float, spread: float) -> float:
    """K' = k / (1 + k spread^2): what is left of a scale when it chooses among ways of finite spread."""
    return k / (1 + k * spread**2)


def coupling(k: float, spread: float, distance: float) -> float:
    """Kappa = k' distance^2 / 2."""
    return effective_scale(k, spread) * distance**2 / 2


def tilted_shares(weights: ArrayLike, ways: ArrayLike, student: ArrayLike, k: float, spread: float) -> Array:
    """Shares of the ways after tilting by exp(-k J): log-odds log(w_1 / w_2) + k' (J_2 - J_1), exactly.

    Each component stays Gaussian; its weight is multiplied by the integral of N(m_i, spread^2 I) exp(-k J), which is
    (1 + k spread^2)^(-D/2) exp(-k' J_i) with J_i = 1/2 ||m_i - student||^2.

    Args:
        weights: (n,) w_i.
        ways: (n, D) m_i.
        student: (D,) its action.
        k: guidance scale.
        spread: standard deviation within a way.
    """
    j = 0.5 * np.square(np.asarray(ways, dtype=float) - np.asarray(student, dtype=float)).sum(axis=1)
    return np.asarray(softmax(np.log(weights) - effective_scale(k, spread) * j))


# ---- students ----


def mean_student(shares: Array, ways: Array) -> Array:
    """Least squared error: the mean of the data."""
    return shares @ ways


def median_student(shares: Array, ways: Array) -> Array:
    """Least absolute error: the median of every coordinate, for ways without spread; at a tie, its middle."""
    student = np.empty(ways.shape[1])
    for axis, column in enumerate(ways.T):
        order = np.argsort(column, kind="stable")
        below = np.cumsum(shares[order])
        low, high = np.searchsorted(below, [0.5 - 1e-12, 0.5 + 1e-12])
        student[axis] = (column[order[low]] + column[order[min(high, len(order) - 1)]]) / 2
    return student


def next_shares(
    shares: ArrayLike,
    ways: ArrayLike,
    k: float,
    spread: float,
    rule: StudentRule,
    weights: ArrayLike | None = None,
) -> Array:
    """The feedback map p' = f(p): the student learns data of these shares, the guided teacher makes the next.

    Args:
        shares: (n,) p, of the ways in the data.
        ways: (n, D).
        k: guidance scale.
        spread: standard deviation within a way.
        rule: where the student stands.
        weights: (n,) of the ways in the unguided teacher; None: all alike.
    """
    shares, ways = np.asarray(shares, dtype=float), np.asarray(ways, dtype=float)
    prior = np.full(len(ways), 1 / len(ways)) if weights is None else np.asarray(weights, dtype=float)
    return tilted_shares(prior, ways, rule(shares, ways), k, spread)


# ---- a mean-learning student: two ways, or n that are all equally far apart ----


def mean_map(share: float, kappa: float, n_ways: int = 2) -> float:
    """f(p) for a mean student and n equidistant, equally frequent ways, of which the others share 1 - p alike.

    p' = 1 / (1 + (n - 1) exp(-kappa (p - q))) with q = (1 - p) / (n - 1). For two ways: expit(kappa (2p - 1)).
    """
    other = (1 - share) / (n_ways - 1)
    return float(expit(kappa * (share - other) - math.log(n_ways - 1)))


def balance_threshold(n_ways: int) -> float:
    """The coupling above which the balanced state is unstable: there f' = kappa / n. In k' distance^2: 2 n."""
    return float(n_ways)


def mean_fixed_points(kappa: float, n_ways: int = 2) -> list[float]:
    """Shares p = f(p) from 1/n up, of the way that leads."""
    grid = np.linspace(1 / n_ways, 1, 4001)
    gap = np.array([mean_map(p, kappa, n_ways) - p for p in grid])
    found = [1 / n_ways]
    for low, high, before, after in zip(grid[1:], grid[2:], gap[1:], gap[2:], strict=False):
        if before * after < 0:
            found.append(float(brentq(lambda p: mean_map(p, kappa, n_ways) - p, low, high)))
    return found


def side_threshold(n_ways: int) -> float:
    """The coupling above which a mean student that has fallen to one way stays there.

    Two ways: 2, where the balanced state becomes unstable. Three and more: below it, so that in between both states are
    stable and the past decides.
    """
    if n_ways == 2:
        return balance_threshold(2)

    def least_coupling(share: float) -> float:
        """The coupling of which `share` is a fixed point."""
        other = (1 - share) / (n_ways - 1)
        return math.log(share / other) / (share - other)

    shares = np.linspace(1 / n_ways + 1e-4, 1 - 1e-6, 20_001)
    return min(least_coupling(float(share)) for share in shares)


# ---- a median-learning student ----


def median_threshold_two_ways(distance: float, spread: float) -> float:
    """K' distance^2 above which a median student leaves the balance of two ways of finite spread, in one dimension.

    Near p = 1/2 the median moves by dx/dp = (2 Phi(m / s) - 1) s / phi(m / s), m = distance / 2, and f' = k' m dx/dp / 2.
    """
    z = distance / (2 * spread)
    if z > 38:  # phi underflows: the least imbalance carries the median over
        return 0.0
    slope = (2 * norm.cdf(z) - 1) * spread / norm.pdf(z)
    return float(4 * distance / slope)


def stuck_share(kappa: float) -> float:
    """Share of either leading way while a median student stands between two of three ways in a plane.

    As long as no way has more than half of the data, the coordinate-wise median of (r, 0) and r (-1/2, +- sqrt(3)/2) is
    (-r/2, 0), half way between the last two. The nearer two then get 1 / (2 + exp(-kappa / 2)) each: below 1/2 at any
    coupling, so that the student of infinitely many data never leaves.
    """
    return float(1 / (2 + math.exp(-kappa / 2)))


def escape_probability(kappa: float, episodes: int) -> float:
    """Chance that chance gives one of the stuck ways more than half of a round's episodes; then the student is there."""
    return float(2 * binom.sf(episodes // 2, episodes, stuck_share(kappa)))


# ---- mixing instead of guidance ----


def mixed_mean(mean: float, lam: float, teacher_mean: float = 0.0) -> float:
    """Where a mean student stands after a round of mixing, by Eq. 6 or Eq. 7: (1 - lambda) teacher + lambda student.

    A contraction toward the teacher's mean, the middle of its ways. In Eq. 6 the shares stay the teacher's.
    """
    return (1 - lam) * teacher_mean + lam * mean


def share_after_choosing(weight: float, lam: float) -> float:
    """Eq. 7 with a student that is already at a way: its share of the data, (1 - lambda) w + lambda."""
    return (1 - lam) * weight + lam


# ---- many binary choices in one chunk ----


def nearest_agrees_in_all(n_samples: int, n_choices: int, share: float = 0.5) -> float:
    """Chance that one of N samples makes all m choices as the student does, each with probability `share`."""
    return float(-np.expm1(n_samples * np.log1p(-(share**n_choices)))) if share < 1 else 1.0


def samples_needed(probability: float, n_choices: int, share: float = 0.5) -> int:
    """Least N for which one of N samples agrees in all m choices with a probability."""
    return math.ceil(math.log1p(-probability) / math.log1p(-(share**n_choices)))


def nearest_agreement(n_samples: int, n_choices: int, share: float = 0.5) -> float:
    """Expected fraction of the m choices in which the nearest of N samples agrees: the largest of N binomials over m."""
    below = binom.cdf(np.arange(n_choices), n_choices, share)
    return float((1 - below**n_samples).sum() / n_choices)


def guided_agreement(kappa: float, share: float = 0.5) -> float:
    """Fraction of choices in which a guided teacher agrees with a student that has made them: expit(logit w + kappa).

    It is the same for any number of choices, since each has actions of its own in the chunk and J is their sum.
    """
    return float(expit(math.log(share / (1 - share)) + kappa))


# ---- rounds ----


def simulate_rounds(
    rng: np.random.Generator,
    ways: ArrayLike,
    k: float,
    spread: float,
    absolute: bool,
    demonstrations: ArrayLike,
    episodes: int,
    rounds: int,
    keep: bool = False,
) -> Array:
    """Rounds with finitely many episodes: sampled actions, and a student at their mean or coordinate-wise median.

    Args:
        rng: of all draws.
        ways: (n, D).
        k: guidance scale.
        spread: standard deviation within a way.
        absolute: the median, else the mean.
        demonstrations: (n,) counts of the ways to start with.
        episodes: of every round.
        rounds: number of rounds.
        keep: the student learns from all data so far, as T does; else from the last round alone.

    Returns:
        (rounds, n) shares of the ways in every round.
    """
    ways = np.asarray(ways, dtype=float)
    prior = np.full(len(ways), 1 / len(ways))
    chosen = np.repeat(np.arange(len(ways)), np.asarray(demonstrations))
    data = ways[chosen] + spread * rng.standard_normal((len(chosen), ways.shape[1]))
    pull = 1 - 1 / (1 + k * spread**2)
    shares = []
    for _ in range(rounds):
        student = np.median(data, axis=0) if absolute else data.mean(axis=0)
        chosen = rng.choice(len(ways), episodes, p=tilted_shares(prior, ways, student, k, spread))
        centers = ways[chosen] + pull * (student - ways[chosen])
        fresh = centers + spread * math.sqrt(1 - pull) * rng.standard_normal((episodes, ways.shape[1]))
        data = np.concatenate([data, fresh]) if keep else fresh
        shares.append(np.bincount(chosen, minlength=len(ways)) / episodes)
    return np.array(shares)
