"""A rollout as arrays, and the record that is kept of every rollout."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Ticket:
    """An episode to be collected.

    Attributes:
        number: in the round.
        seed: the environment's.
        scale: guidance scale, or mixing weight; 0: the teacher as it acts alone.
        student_share: share of the longest possible episode in which the student acts before the teacher does.
        retry: whether an earlier round's episode from this start has failed.
    """

    number: int
    seed: int
    scale: float
    student_share: float = 0.0
    retry: bool = False

    @property
    def guided(self) -> bool:
        """Whether the teacher is guided in it."""
        return self.scale > 0


@dataclass
class Episode:
    """A finished rollout of T steps.

    Attributes:
        ticket: what was asked for.
        task: the environment's description of its task.
        observations: feature name to (T, ...); vectors float32, images uint8 (T, H, W, C).
        actions: (T, A) float32, as executed, in the environment's units.
        rewards: (T,) float32.
        successes: (T,) bool, or None if the environment reports no `is_success`.
        j: mean discrepancy of its decisions' executed chunks (action J), NaN without a student.
        shift: mean root-mean-square shift of its guided denoising steps, in sigmas; NaN if unguided.
        student_steps: steps that the student executed before the teacher took over.
        student_alone: whether the episode ended before the teacher took over.
    """

    ticket: Ticket
    task: str
    observations: dict[str, Array]
    actions: Array
    rewards: Array
    successes: Array | None
    j: float
    shift: float
    student_steps: int = 0
    student_alone: bool = False

    def __len__(self) -> int:
        """Number of steps T."""
        return len(self.actions)

    @property
    def success(self) -> bool | None:
        """Whether the environment counts the episode as solved at its last step; None if it does not say."""
        return None if self.successes is None else bool(self.successes[-1])

    @property
    def max_reward(self) -> float:
        """Largest reward of any step."""
        return float(self.rewards.max())

    def save(self, path: Path) -> None:
        """Write the arrays to an .npz file, atomically."""
        arrays: dict[str, Any] = {f"observation/{key}": value for key, value in self.observations.items()}
        arrays |= {"actions": self.actions, "rewards": self.rewards, "task": np.array(self.task)}
        if self.successes is not None:
            arrays["successes"] = self.successes
        partial = path.with_suffix(".partial.npz")
        np.savez(partial, **arrays)
        partial.replace(path)

    @classmethod
    def load(cls, path: Path, record: EpisodeRecord) -> Episode:
        """Read what `save` wrote; the record supplies what is not an array."""
        with np.load(path) as arrays:
            return cls(
                ticket=Ticket(record.number, record.seed, record.scale, retry=record.retry),
                task=str(arrays["task"]),
                observations={
                    key.removeprefix("observation/"): arrays[key]
                    for key in arrays.files
                    if key.startswith("observation/")
                },
                actions=arrays["actions"],
                rewards=arrays["rewards"],
                successes=arrays["successes"] if "successes" in arrays.files else None,
                j=record.j,
                shift=record.shift,
                student_steps=record.student_steps,
                student_alone=record.student_alone,
            )


@dataclass(frozen=True)
class EpisodeRecord:
    """What is remembered of every generated episode, kept or not.

    Attributes:
        passed: whether it met the success filter's criterion.
        trivial: whether its start already met it, or it was too short to teach anything; counts nowhere.
        kept: whether it entered the replay.
        student_steps: steps that the student executed before the teacher took over.
        student_alone: whether the episode ended before the teacher took over.
        retry: whether an earlier round's episode from this start has failed.
    """

    number: int
    seed: int
    scale: float
    length: int
    max_reward: float
    success: bool | None
    passed: bool
    trivial: bool
    kept: bool
    j: float = field(default=float("nan"))
    shift: float = field(default=float("nan"))
    student_steps: int = 0
    student_alone: bool = False
    retry: bool = False

    def to_json(self) -> dict[str, Any]:
        """A JSON object; NaN becomes null."""
        return {key: None if value != value else value for key, value in asdict(self).items()}

    @classmethod
    def from_json(cls, entry: dict[str, Any]) -> EpisodeRecord:
        """The inverse of `to_json`."""
        nans = {key: float("nan") for key in ("j", "shift") if entry[key] is None}
        return cls(**{**entry, **nans})
