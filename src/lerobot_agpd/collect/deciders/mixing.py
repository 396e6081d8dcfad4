"""`mixing`: teacher and student share the actions (DAgger, arXiv:1011.0686; Eq. 6-7)."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_agpd.collect.config import MixingConfig
from lerobot_agpd.collect.decider import Decision
from lerobot_agpd.collect.deciders.pair import Pair, PairDecider, unknown
from lerobot_agpd.guidance.teacher import History


class MixedPolicies(PairDecider):
    """Executes the teacher's chunk A_E and the student's A_A in shares 1 - lambda and lambda.

    - `interpolate`: lambda A_A + (1 - lambda) A_E, in raw actions (Eq. 6).
    - `switch`: A_A with probability lambda, else A_E, drawn at every decision (Eq. 7).

    Eq. 7 is printed as the distribution of Eq. 6; they are different strategies. Lambda is the student's share,
    DAgger's beta the expert's: lambda = 1 - beta.
    """

    def __init__(self, pair: Pair, generator: torch.Generator, config: MixingConfig):
        """Mix in the way `config` says."""
        super().__init__(pair, generator)
        self.config = config

    def decide(self, history: History, strength: Tensor, rolling_in: Tensor | None = None) -> Decision:
        """Mixed chunks; `strength` is lambda, at 0 they are the teacher's bit for bit, at 1 the student's."""
        of_teacher = self.pair.teacher_actions(history, self.generator)  # (B, n, A) raw
        of_student = self.pair.student_actions(history).to(of_teacher)
        if self.config.form == "switch":
            strength = self._coins(strength)
        mixed = torch.lerp(of_teacher, of_student, strength.to(of_teacher)[:, None, None])
        return Decision(
            actions=mixed,
            j=self.pair.action_j(mixed, self.pair.alignment.teacher_units(of_student)),
            shift=unknown(mixed),
            recorded=of_teacher if self.config.relabel else None,
        )

    def _coins(self, weight: Tensor) -> Tensor:
        """1 with probability `weight`, else 0, (B,)."""
        device = self.generator.device
        drawn = torch.rand(len(weight), generator=self.generator, device=device)  # in [0, 1)
        return (drawn < weight.to(device)).to(weight)
