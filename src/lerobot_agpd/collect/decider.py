"""What a collection strategy is to a rollout: observation histories in, chunks out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from lerobot_agpd.collect.stopwatch import Stopwatch
from lerobot_agpd.guidance.teacher import History


@dataclass(frozen=True)
class Decision:
    """Chunks to execute.

    Attributes:
        actions: (B, n, A) in the environment's units.
        j: (B,) discrepancy between what is executed and the student's chunk; NaN without a student.
        shift: (B,) mean shift of the guided denoising steps in sigmas; NaN where unguided.
        recorded: (B, n, A) what the episode records; None: what is executed.
    """

    actions: Tensor
    j: Tensor
    shift: Tensor
    recorded: Tensor | None = None


class Decider(Protocol):
    """A collection strategy."""

    @property
    def n_obs_steps(self) -> int:
        """Length of the observation history it needs."""
        ...

    @property
    def stopwatch(self) -> Stopwatch:
        """Takes the time of everything that a rollout with this strategy does."""
        ...

    def decide(self, history: History, strength: Tensor, rolling_in: Tensor | None = None) -> Decision:
        """Chunks to execute.

        Args:
            history: raw observations (B, n_obs_steps, ...), and under "task" B instructions.
            strength: (B,) guidance scales, or mixing weights; at 0 the teacher acts as it does alone.
            rolling_in: (B,) bool, True where the student still acts (only with strategy=rollin); None: nowhere.
        """
        ...
