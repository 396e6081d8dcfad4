"""A rollout as arrays, and the record of a rollout."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from lerobot.utils.constants import ACTION, REWARD, SUCCESS
from numpy.typing import NDArray

Array = NDArray[Any]

NAN = float("nan")

MAY_BE_NAN = ("max_reward", "discrepancy", "guidance_shift")
"""Numbers of a record that may be unknown."""


@dataclass(frozen=True)
class EpisodeSpec:
    """What is to be collected.

    Attributes:
        number: in the round.
        seed: of the environment.
        strength: pull, guidance scale or mixing weight; 0: the teacher acts alone.
        student_fraction: fraction of the longest possible episode in which the student acts before the teacher.
        retry: whether an earlier round's episode from this start failed.
    """

    number: int
    seed: int
    strength: float
    student_fraction: float = 0.0
    retry: bool = False

    @property
    def teacher_only(self) -> bool:
        """Whether the strategy leaves the teacher's actions as they are."""
        return self.strength == 0


@dataclass
class Episode:
    """A finished rollout of T steps.

    Attributes:
        spec: what was to be collected.
        task: the environment's description of its task.
        observations: feature name to (T, ...); vectors float32, images uint8 (T, H, W, C).
        actions: (T, A) float32, as executed, in the environment's units.
        rewards: (T,) float32.
        successes: (T,) bool, or None if the environment reports no `is_success`.
        discrepancy: mean action J of the executed chunks, NaN without a student.
        guidance_shift: mean root-mean-square shift of the guided denoising steps, in sigmas; NaN if unguided.
        student_steps: steps that the student executed before the teacher took over.
        student_alone: whether the episode ended before the teacher took over.
        problem: why the environment did not finish it; then observations and actions are missing.
    """

    spec: EpisodeSpec
    task: str
    observations: dict[str, Array]
    actions: Array
    rewards: Array
    successes: Array | None
    discrepancy: float = NAN
    guidance_shift: float = NAN
    student_steps: int = 0
    student_alone: bool = False
    problem: str | None = None

    def __len__(self) -> int:
        """Number of steps T."""
        return len(self.actions)

    @property
    def is_success(self) -> bool | None:
        """What the environment says at the last step; None if it reports no success."""
        return None if self.successes is None else bool(self.successes[-1])

    @property
    def max_reward(self) -> float:
        """Largest reward of any step; NaN without a step."""
        return float(self.rewards.max()) if len(self.rewards) else NAN

    @property
    def columns(self) -> dict[str, Array]:
        """All arrays (T, ...) under LeRobot's feature names."""
        columns = {**self.observations, ACTION: self.actions, REWARD: self.rewards}
        return columns if self.successes is None else {**columns, SUCCESS: self.successes}


@dataclass(frozen=True)
class EpisodeRecord:
    """Facts about a generated episode, kept or not.

    Attributes:
        number: in the round.
        seed: of the environment.
        strength: pull, guidance scale or mixing weight; 0: the teacher acted alone.
        length: number of steps.
        max_reward: largest reward of any step.
        is_success: what the environment says at the last step; None if it reports no success.
        success: whether the episode met the success filter's criterion.
        solved_at_start: whether its first step met the criterion, or it is too short to train on; counts nowhere.
        kept: whether it became part of the replay.
        discrepancy: mean action J of the executed chunks, NaN without a student.
        guidance_shift: mean root-mean-square shift of the guided denoising steps, in sigmas; NaN if unguided.
        student_steps: steps that the student executed before the teacher took over.
        student_alone: whether the episode ended before the teacher took over.
        retry: whether an earlier round's episode from this start failed.
        invalid: what is wrong with the episode: a number that is not finite, or an environment that got stuck; such an
            episode never succeeds and is never kept. None: nothing.
    """

    number: int
    seed: int
    strength: float
    length: int
    max_reward: float
    is_success: bool | None
    success: bool
    solved_at_start: bool
    kept: bool
    discrepancy: float = NAN
    guidance_shift: float = NAN
    student_steps: int = 0
    student_alone: bool = False
    retry: bool = False
    invalid: str | None = None

    def to_json(self) -> dict[str, object]:
        """A JSON object; NaN and infinite numbers become null."""
        entry = asdict(self)
        for key in MAY_BE_NAN:
            if not math.isfinite(entry[key]):
                entry[key] = None
        return entry

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> EpisodeRecord:
        """The inverse of `to_json`."""
        nans = {key: NAN for key in MAY_BE_NAN if entry[key] is None}
        return cls(**{**entry, **nans})
