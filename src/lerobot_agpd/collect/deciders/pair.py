"""A teacher and a student at the same observations, and what every strategy needs of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, Self

import torch
from torch import Tensor

from lerobot_agpd.collect.decider import Decision
from lerobot_agpd.collect.stopwatch import Stopwatch
from lerobot_agpd.guidance.alignment import Alignment
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy, Discrepancy
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.guidance.teacher import History, Teacher

Proposal = Callable[[History], Tensor]
"""A student: raw observations (B, T, ...) to its chunk (B, S, A) in its own normalised space."""

DiscrepancyFactory = Callable[[History, Tensor, ActionDiscrepancy], Discrepancy]
"""Builds J from raw observations (B, T, ...), the student's chunk (B, S, A) and the action J of the same chunk."""


@dataclass(frozen=True)
class Pair:
    """Teacher and student, their chunks cut to the n steps that are executed.

    Attributes:
        teacher: the frozen policy.
        propose: the student.
        alignment: which steps and units of their chunks belong together.
        make_discrepancy: builds the J that guides; None: the action J.
        student_n_obs_steps: observations that the student needs.
        stopwatch: takes the time of both.
    """

    teacher: Teacher
    propose: Proposal
    alignment: Alignment
    make_discrepancy: DiscrepancyFactory | None = None
    student_n_obs_steps: int = 1
    stopwatch: Stopwatch = field(default_factory=Stopwatch)

    @property
    def n_obs_steps(self) -> int:
        """The longer of both histories."""
        return max(self.teacher.n_obs_steps, self.student_n_obs_steps)

    def teacher_actions(
        self, history: History, generator: torch.Generator, guide: Guide | None = None
    ) -> Tensor:
        """The teacher's executed steps, (B, n, A) raw."""
        with self.stopwatch.measure("teacher"):
            return self.teacher.sample(history, guide, generator)[:, : self.alignment.n_steps]

    def student_chunk(self, history: History) -> Tensor:
        """The student's chunk A_hat, (B, S, A) in its own normalised space (Eq. 19)."""
        with self.stopwatch.measure("student"):
            return self.propose(history)

    def student_actions(self, history: History) -> Tensor:
        """The student's executed steps, (B, n, A) raw."""
        return self.alignment.student_raw(self.student_chunk(history)[:, : self.alignment.n_steps])

    def action_j(self, actions: Tensor, target: Tensor) -> Tensor:
        """J = 1/2 ||A - A_hat||^2, (B,), of raw actions A and A_hat in the teacher's units, (B, n, A) both."""
        gap = self.alignment.teacher_units(actions) - target.to(actions)
        return 0.5 * gap.square().sum(dim=(1, 2))


class PairDecider(ABC):
    """A strategy made of a teacher, a student and a source of noise."""

    def __init__(self, pair: Pair, generator: torch.Generator):
        """Decide with `pair`; noise comes from `generator`."""
        self.pair = pair
        self.generator = generator

    @property
    def n_obs_steps(self) -> int:
        """The longer of both histories."""
        return self.pair.n_obs_steps

    @property
    def stopwatch(self) -> Stopwatch:
        """The pair's."""
        return self.pair.stopwatch

    @abstractmethod
    def decide(self, history: History, strength: Tensor, rolling_in: Tensor | None = None) -> Decision:
        """Chunks to execute; see `Decider`."""

    def reseeded(self, generator: torch.Generator) -> Self:
        """The same strategy with another source of noise and a stopwatch of its own."""
        clone = copy(self)
        clone.generator = generator
        clone.pair = replace(self.pair, stopwatch=Stopwatch())
        return clone


def rows(history: History, chosen: Tensor) -> dict[str, Any]:
    """The rows of a history that a mask (B,) chooses."""
    return {
        key: value[chosen.to(value.device)]
        if isinstance(value, Tensor)
        else [entry for entry, wanted in zip(value, chosen.tolist(), strict=True) if wanted]
        for key, value in history.items()
    }


def unknown(like: Tensor) -> Tensor:
    """NaN for every row of chunks (B, ...)."""
    return torch.full((len(like),), float("nan"))
