"""Experts that know several ways: every episode takes one, drawn at its start."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from lerobot_agpd.envs.experts.base import Array, Expert
from lerobot_agpd.flag_checks import require


class CorrelatedNoise:
    """Normal noise whose values resemble each other from one step to the next, as the hand of a person trembles."""

    def __init__(self, std: float, correlation: float, dim: int, rng: np.random.Generator) -> None:
        """Begin an episode; `correlation` is that of one step with the next."""
        self._innovation = std * np.sqrt(1.0 - correlation**2)
        self._correlation, self._rng = correlation, rng
        self._value: Array = np.zeros(dim)

    def __call__(self) -> Array:
        """Noise (dim,) of the next step."""
        self._value = self._correlation * self._value + self._innovation * self._rng.standard_normal(
            len(self._value)
        )
        return self._value


@dataclass(frozen=True)
class WaysExpert:
    """Draws a way for every episode.

    Attributes:
        task: name of the task, for messages.
        n_ways: number of its ways.
        follow: the expert that takes a way for one episode, given the episode's random numbers.
        fractions: probability of every way; None: all alike.
    """

    task: str
    n_ways: int
    follow: Callable[[int, np.random.Generator], Expert]
    fractions: tuple[float, ...] | None = None

    def with_ways(self, fractions: Sequence[float]) -> Self:
        """The same expert with other probabilities of the ways.

        Raises:
            FlagError: if there is not one per way, or they do not sum to 1.
        """
        require(
            len(fractions) == self.n_ways and min(fractions) >= 0 and abs(sum(fractions) - 1) <= 1e-6,
            f"--ways={list(fractions)} must be {self.n_ways} fractions that sum to 1, one for each way of {self.task}",
        )
        return replace(self, fractions=tuple(fractions))

    def for_episode(self, rng: np.random.Generator) -> Expert:
        """Draw a way and return the expert that follows it."""
        return self.follow(int(rng.choice(self.n_ways, p=self.fractions)), rng)
