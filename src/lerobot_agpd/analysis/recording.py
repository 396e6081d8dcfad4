"""What is remembered of a guided rollout: its steps, and what teacher and student planned at every decision."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]

COLORS = {"teacher": (0, 114, 178), "guided": (213, 94, 0), "student": (230, 60, 180)}
LABELS = {"teacher": "teacher alone", "guided": "guided teacher", "student": "student"}


@dataclass(frozen=True)
class Chunks:
    """The three chunks of one decision, (n, A) in the environment's units.

    Attributes:
        teacher: without guidance, from the same initial noise as `guided`.
        guided: pulled toward the student; executed.
        student: what it was pulled toward.
    """

    teacher: Array
    guided: Array
    student: Array

    def items(self) -> list[tuple[str, Array]]:
        """Names and chunks."""
        return [(field.name, getattr(self, field.name)) for field in fields(self)]


@dataclass(frozen=True)
class DecisionRecord:
    """One decision.

    Attributes:
        step: environment step at which the chunks begin.
        chunks: the three chunks.
        j_teacher: discrepancy J between the unguided chunk and the student's.
        j_guided: discrepancy J between the executed chunk and the student's.
        shift_in_sigmas: mean shift of the guided denoising steps; NaN if unguided.
    """

    step: int
    chunks: Chunks
    j_teacher: float
    j_guided: float
    shift_in_sigmas: float


@dataclass(frozen=True)
class RolloutRecord:
    """A rollout of T steps.

    Attributes:
        observations: feature name to (T, D) vectors or (T, H, W, C) uint8 images.
        actions: (T, A) as executed.
        rewards: (T,).
        successes: (T,) bool, or None if the environment does not say.
        decisions: in the order of their steps.
        frames: T rendered frames (H, W, 3) uint8, or none.
        to_frame: maps actions (n, 2) to pixels (n, 2) of the frame; None if actions are no positions in it.
    """

    observations: Mapping[str, Array]
    actions: Array
    rewards: Array
    successes: Array | None
    decisions: Sequence[DecisionRecord]
    frames: Sequence[Array] = ()
    to_frame: Callable[[Array], Array] | None = None

    @property
    def cameras(self) -> list[str]:
        """Observations that are images."""
        return [key for key, values in self.observations.items() if values.ndim == 4]

    @property
    def vectors(self) -> list[str]:
        """Observations that are vectors."""
        return [key for key, values in self.observations.items() if values.ndim == 2]
