"""A teacher and a student at the same observations, their chunks cut to the same steps in the same space.

LeRobot's diffusion policies predict `horizon` steps of which the first n_obs_steps - 1 lie in the past; an ACT
chunk starts now. The teacher normalizes actions to [-1, 1], ACT to zero mean and unit variance.

    time           t-1    t    t+1   ...  t+n-1  ...
    teacher        [0]   [1]   [2]   ...   [n]   ... [horizon-1]     (n_obs_steps = 2)
    student              [0]   [1]   ...  [n-1]  ... [chunk_size-1]
    compared              *     *     *     *
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy, Discrepancy
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.guidance.teacher import History, Teacher
from lerobot_agpd.stopwatch import Stopwatch

StudentFn = Callable[[History], Tensor]
"""A student: raw observations (B, T, ...) to its chunk (B, S, A) in its own normalized space."""

ActionMap = Callable[[Tensor], Tensor]
"""Map of actions (..., A) from one space to another, differentiable."""


@dataclass(frozen=True)
class TeacherStudent:
    """Teacher and student, their chunks cut to the n steps that are executed.

    Attributes:
        teacher: the frozen policy.
        student: the student.
        n_steps: number of compared (and executed) steps n.
        normalize: maps raw actions to the student's normalized space.
        unnormalize: the inverse.
        make_discrepancy: builds the J that guides, from this pair, raw observations (B, T, ...), the student's chunk
            (B, S, A) and the action J of the same chunk; None: the action J.
        student_n_obs_steps: observations that the student needs.
        stopwatch: takes the time of both.
    """

    teacher: Teacher
    student: StudentFn
    n_steps: int
    normalize: ActionMap
    unnormalize: ActionMap
    make_discrepancy: Callable[[TeacherStudent, History, Tensor, ActionDiscrepancy], Discrepancy] | None = (
        None
    )
    student_n_obs_steps: int = 1
    stopwatch: Stopwatch = field(default_factory=Stopwatch)

    @property
    def n_obs_steps(self) -> int:
        """The longer of both histories."""
        return max(self.teacher.n_obs_steps, self.student_n_obs_steps)

    # ---- chunks ----

    def propose(self, history: History) -> Tensor:
        """The student's chunk A_hat, (B, S, A) in its own normalized space (Eq. 19)."""
        with self.stopwatch.measure("student"):
            return self.student(history)

    def teacher_actions(
        self, history: History, generator: torch.Generator, guide: Guide | None = None
    ) -> Tensor:
        """The teacher's executed steps, (B, n, A) raw."""
        with self.stopwatch.measure("teacher"):
            actions = self.teacher.sample(history, guide, generator)[:, : self.n_steps]
        self.stopwatch.count("teacher", len(actions))
        return actions

    def student_actions(self, history: History) -> Tensor:
        """The student's executed steps, (B, n, A) raw."""
        return self.unnormalize(self.propose(history)[:, : self.n_steps])

    # ---- spaces ----

    def student_in_teacher_space(self, chunk: Tensor) -> Tensor:
        """The student's executed steps, (B, n, A) teacher-normalized, for its chunk (B, S, A); differentiable."""
        return self.teacher.normalize(self.unnormalize(chunk[:, : self.n_steps]))

    def teacher_in_student_space(self, executed: Tensor) -> Tensor:
        """Executed steps (B, n, A) of a teacher's chunk in the student's normalized space; differentiable."""
        return self.normalize(self.teacher.unnormalize(executed))

    # ---- discrepancy ----

    def action_discrepancy(self, chunk_hat: Tensor) -> ActionDiscrepancy:
        """J = 1/2 ||A - A_hat||^2 of the student's chunk (B, S, A)."""
        return ActionDiscrepancy(self.student_in_teacher_space(chunk_hat), self.teacher.start)

    def guiding_discrepancy(
        self, history: History, chunk_hat: Tensor, action_j: ActionDiscrepancy
    ) -> Discrepancy:
        """The J whose gradient guides: the learned one if there is one."""
        return (
            self.make_discrepancy(self, history, chunk_hat, action_j) if self.make_discrepancy else action_j
        )

    def executed_discrepancy(self, actions: Tensor, target: Tensor) -> Tensor:
        """The action J, (B,), of raw executed actions against a teacher-normalized target, (B, n, A) both."""
        gap = self.teacher.normalize(actions) - target.to(actions)
        return 0.5 * gap.square().sum(dim=(1, 2))
