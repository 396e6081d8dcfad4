"""Remembers some of the situations that a round went through, for its diagnostics."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.collect.decider import Decision
from lerobot_agpd.collect.deciders.pair import PairDecider
from lerobot_agpd.collect.stopwatch import Stopwatch
from lerobot_agpd.guidance.teacher import History


class Witness:
    """Decides as another strategy does, and keeps a uniform sample of the histories it decided at.

    The sample is drawn with random numbers of its own (reservoir sampling, algorithm R: Vitter, ACM TOMS 11(1),
    1985): being watched does not change an episode. Histories at which the student acted are not sampled.
    """

    def __init__(self, decider: PairDecider, size: int, seed: int):
        """Watch `decider` and keep `size` histories."""
        self.decider = decider
        self.size = size
        self._rows: list[dict[str, Any]] = []
        self._n_seen = 0
        self._rng = np.random.default_rng([seed, size])

    @property
    def n_obs_steps(self) -> int:
        """The strategy's."""
        return self.decider.n_obs_steps

    @property
    def stopwatch(self) -> Stopwatch:
        """The strategy's."""
        return self.decider.stopwatch

    def decide(self, history: History, strength: Tensor, rolling_in: Tensor | None = None) -> Decision:
        """The strategy's decision."""
        for row in range(len(strength)):
            if rolling_in is None or not rolling_in[row]:
                self._see(history, row)
        return self.decider.decide(history, strength, rolling_in)

    def _see(self, history: History, row: int) -> None:
        self._n_seen += 1
        place = len(self._rows) if len(self._rows) < self.size else int(self._rng.integers(self._n_seen))
        if place < self.size:
            kept = {key: value[row] for key, value in history.items()}
            self._rows[place : place + 1] = [kept]

    def history(self) -> dict[str, Any] | None:
        """The sampled histories as one, (at most `size`, n_obs_steps, ...); None before the first decision."""
        if not self._rows:
            return None
        return {
            key: torch.stack([row[key] for row in self._rows])
            if isinstance(first, Tensor)
            else [row[key] for row in self._rows]
            for key, first in self._rows[0].items()
        }
