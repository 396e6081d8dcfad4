"""`rollin`: the student acts first, then the teacher finishes the episode.

Not in the paper, whose student never acts during collection. The teacher shows what to do in states that the
student gets itself into, which is DAgger's point, without executing the student's actions next to the teacher's.
"""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor

from lerobot_agpd.collect.decider import Decision
from lerobot_agpd.collect.deciders.pair import Pair, PairDecider, rows, unknown
from lerobot_agpd.guidance.teacher import History


class RollIn(PairDecider):
    """The student in the episodes that are rolling in, another strategy in the others."""

    def __init__(self, pair: Pair, finisher: PairDecider):
        """Take over with `finisher`."""
        super().__init__(pair, finisher.generator)
        self.finisher = finisher

    def reseeded(self, generator: torch.Generator) -> Self:
        """Also the finisher."""
        clone = super().reseeded(generator)
        clone.finisher = self.finisher.reseeded(generator)
        return clone

    def decide(self, history: History, strength: Tensor, rolling_in: Tensor | None = None) -> Decision:
        """The student's chunks where `rolling_in`; their J and shift are NaN. The finisher's elsewhere."""
        if rolling_in is None or not rolling_in.any():
            return self.finisher.decide(history, strength)
        of_student = self.pair.student_actions(rows(history, rolling_in)).cpu()
        actions = of_student.new_empty(len(rolling_in), *of_student.shape[1:])
        actions[rolling_in] = of_student
        j, shift = unknown(actions), unknown(actions)
        if not rolling_in.all():
            rest = ~rolling_in
            finishing = self.finisher.decide(rows(history, rest), strength[rest])
            actions[rest] = finishing.actions.to(actions)
            j[rest], shift[rest] = finishing.j.to(j), finishing.shift.to(shift)
        return Decision(actions=actions, j=j, shift=shift)
