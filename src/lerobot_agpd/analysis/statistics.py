"""Intervals for the numbers this project reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
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
    """Share of successes with Wilson's interval.

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
    centre = float(np.mean(values))
    half = float(t.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n))
    return Estimate(centre, centre - half, centre + half, n)
