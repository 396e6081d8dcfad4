"""Intervals for the numbers this project reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import binomtest, t


@dataclass(frozen=True)
class Estimate:
    """A mean with its 95 % confidence interval."""

    mean: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        """E.g. `0.91 [0.86, 0.94]`."""
        return f"{self.mean:.2f} [{self.low:.2f}, {self.high:.2f}]"


def success_rate(successes: Sequence[bool]) -> Estimate:
    """Success rate with Wilson's interval.

    Raises:
        ValueError: for an empty sequence.
    """
    if not successes:
        raise ValueError("no episodes: a success rate needs at least one")
    n = len(successes)
    interval = binomtest(sum(successes), n).proportion_ci(method="wilson")
    return Estimate(sum(successes) / n, float(interval.low), float(interval.high), n)


def mean(values: Sequence[float]) -> Estimate:
    """Mean with Student's t interval over episodes.

    Raises:
        ValueError: for fewer than two values.
    """
    if len(values) < 2:
        raise ValueError(f"an interval needs at least two episodes, got {len(values)}")
    n = len(values)
    center = float(np.mean(values))
    half = float(t.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n))
    return Estimate(center, center - half, center + half, n)


@dataclass(frozen=True)
class Difference:
    """A mean difference with its 95 % confidence interval.

    Attributes:
        mean: first minus second.
        low: lower end.
        high: upper end.
        n_seeds: training seeds that both sides have.
        n_environments: environment seeds, the same on both sides and for every training seed.
    """

    mean: float
    low: float
    high: float
    n_seeds: int
    n_environments: int

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval lies on one side of zero."""
        return self.low > 0 or self.high < 0

    def __str__(self) -> str:
        """E.g. `+0.05 [+0.01, +0.09]`."""
        return f"{self.mean:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


def paired_difference(first: ArrayLike, second: ArrayLike) -> Difference:
    """Mean of `first - second` over training seeds and environments, (S, N) outcomes each.

    Rows are training seeds, columns environment seeds. Both factors are random and crossed: every student of a method
    meets the same environments. With the mean squares of the two-way layout of the paired differences,

        Var(mean) = (max(MS_seed, MS_rest) + max(0, MS_environment - MS_rest)) / (S N)

    and a t interval with Satterthwaite's degrees of freedom (Searle, Casella & McCulloch, Variance Components, 1992).
    The two maxima keep a lucky small mean square from narrowing the interval: it covers at least 95 % where seeds
    matter little. Three seeds leave two degrees of freedom (a factor of 4.3), so intervals are wide; a bootstrap over
    three seeds would look narrower and miss the truth in up to a fifth of the cases. With one training seed only
    environments are random, and the interval says nothing about other seeds. Pairs that all differ alike leave an
    interval of no width, which is no certainty.

    Raises:
        ValueError: if the shapes differ, are not (S, N), or N < 2.
    """
    a, b = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] < 2:
        raise ValueError(
            f"paired outcomes must both be (training seeds, environments >= 2), got {a.shape} and {b.shape}"
        )
    difference = a - b  # (S, N)
    n_seeds, n_environments = difference.shape
    variance, dof = _crossed_variance(difference)
    center = float(difference.mean())
    half = float(t.ppf(0.975, dof) * np.sqrt(variance)) if variance > 0 else 0.0
    return Difference(center, center - half, center + half, n_seeds, n_environments)


def _crossed_variance(values: np.ndarray) -> tuple[float, float]:
    """Variance of the mean of (S, N) values, both factors random, and its degrees of freedom."""
    n_rows, n_columns = values.shape
    center = values.mean()
    rows = values.mean(axis=1, keepdims=True) - center
    columns = values.mean(axis=0, keepdims=True) - center
    ms_columns = n_rows * np.sum(columns**2) / (n_columns - 1)
    if n_rows == 1:
        return float(ms_columns / n_columns), n_columns - 1
    ms_rows = n_columns * np.sum(rows**2) / (n_rows - 1)
    rest_dof = (n_rows - 1) * (n_columns - 1)
    ms_rest = np.sum((values - center - rows - columns) ** 2) / rest_dof
    ms_rows = max(ms_rows, ms_rest)
    total, spread = ms_rows, ms_rows**2 / (n_rows - 1)
    if ms_columns > ms_rest * (1 + 1e-9):  # equal but for rounding: environments explain nothing
        total += ms_columns - ms_rest
        spread += ms_columns**2 / (n_columns - 1) + ms_rest**2 / rest_dof
    return float(total / values.size), float(total**2 / spread) if spread > 0 else n_rows - 1.0
