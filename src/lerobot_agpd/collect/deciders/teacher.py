"""`replay` and `guided`: the teacher acts, alone or pulled toward the student."""

from __future__ import annotations

from typing import Self

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.collect.decider import Decision
from lerobot_agpd.collect.deciders.pair import Pair, PairDecider, unknown
from lerobot_agpd.guidance.config import GuidanceConfig
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.guidance.teacher import History


class TeacherAlone(PairDecider):
    """`replay`: the unguided teacher acts (policy distillation, PD); the student is not asked."""

    def decide(self, history: History, strength: Tensor, rolling_in: Tensor | None = None) -> Decision:
        """The teacher's chunks; strengths are ignored."""
        actions = self.pair.teacher_actions(history, self.generator)
        return Decision(actions=actions, j=unknown(actions), shift=unknown(actions))


class GuidedTeacher(PairDecider):
    """`guided`: the teacher denoises, pulled toward the chunk that the student proposes (AGPD, Eq. 19-20).

    With a quantile q > 0, which the paper does not have, only decisions are guided at which teacher and student
    disagree: where the action J of the unguided chunk exceeds the q-quantile of the decisions so far. This costs
    a second sample per decision, from the same noise.
    """

    def __init__(self, pair: Pair, generator: torch.Generator, config: GuidanceConfig, quantile: float = 0.0):
        """Guide by the pair's discrepancy."""
        super().__init__(pair, generator)
        self.config = config
        self.quantile = quantile
        self._past_j: list[float] = []

    def reseeded(self, generator: torch.Generator) -> Self:
        """Also with a memory of its own."""
        clone = super().reseeded(generator)
        clone._past_j = list(self._past_j)
        return clone

    def decide(self, history: History, strength: Tensor, rolling_in: Tensor | None = None) -> Decision:
        """Guided chunks; rows of strength 0 are the teacher's own."""
        chunk_hat = self.pair.student_chunk(history)  # (B, S, A), student-normalised
        alignment = self.pair.alignment
        action_j = ActionDiscrepancy(alignment.student_in_teacher_units(chunk_hat), alignment.start)
        scale = strength.to(chunk_hat.device)
        if self.quantile > 0:
            scale = self._where_they_disagree(history, action_j, scale)
        guide = self._guide(history, chunk_hat, action_j, scale)
        actions = self.pair.teacher_actions(history, self.generator, guide)
        shift = unknown(actions).to(scale)
        if guide is not None and guide.shift_in_sigmas:
            mean_shift = torch.stack(guide.shift_in_sigmas).mean(dim=0)  # (B,)
            shift = torch.where(scale.to(mean_shift) > 0, mean_shift, torch.nan)
        return Decision(actions=actions, j=self.pair.action_j(actions, action_j.target), shift=shift)

    def _guide(
        self, history: History, chunk_hat: Tensor, action_j: ActionDiscrepancy, scale: Tensor
    ) -> Guide | None:
        """None if no row is guided: then the teacher need not be one that can be."""
        if not bool((scale > 0).any()):
            return None
        make = self.pair.make_discrepancy
        return Guide(
            make(history, chunk_hat, action_j) if make else action_j,
            scale,
            at=self.config.at,
            trust_region=self.config.trust_region,
        )

    def _where_they_disagree(self, history: History, action_j: ActionDiscrepancy, scale: Tensor) -> Tensor:
        """The scales, 0 where the unguided chunk is near the student's; leaves the noise as it was."""
        noise = self.generator.get_state()
        alone = self.pair.teacher_actions(history, self.generator)
        self.generator.set_state(noise)
        j = self.pair.action_j(alone, action_j.target)
        self._past_j.extend(j.tolist())
        threshold = float(np.quantile(self._past_j, self.quantile))
        return scale * (j > threshold).to(scale)
