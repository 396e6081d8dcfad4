"""Which steps of two chunks describe the same moments, and in which units to compare them.

LeRobot's diffusion policies predict `horizon` steps of which the first n_obs_steps - 1 lie in the past; an ACT
chunk starts now. The teacher normalises actions to [-1, 1], ACT to zero mean and unit variance.

    time           t-1    t    t+1   ...  t+n-1  ...
    teacher        [0]   [1]   [2]   ...   [n]   ... [horizon-1]     (n_obs_steps = 2)
    student              [0]   [1]   ...  [n-1]  ... [chunk_size-1]
    compared              *     *     *     *
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

Units = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Alignment:
    """The shared window of a teacher's and a student's chunk.

    Attributes:
        start: index of the current step in the teacher's chunk.
        n_steps: number of compared (and executed) steps n.
        teacher_units: maps raw actions (..., A) to the teacher's normalised space.
        teacher_raw: the inverse.
        student_units: maps raw actions to the student's normalised space.
        student_raw: the inverse.
    """

    start: int
    n_steps: int
    teacher_units: Units
    teacher_raw: Units
    student_units: Units
    student_raw: Units

    def student_in_teacher_units(self, chunk: Tensor) -> Tensor:
        """The student's executed steps, (B, n, A), for its chunk (B, S, A); differentiable."""
        return self.teacher_units(self.student_raw(chunk[:, : self.n_steps]))

    def teacher_in_student_units(self, executed: Tensor) -> Tensor:
        """Executed steps (B, n, A) of a teacher's chunk in the student's normalised space; differentiable."""
        return self.student_units(self.teacher_raw(executed))
