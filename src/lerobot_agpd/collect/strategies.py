"""Collection strategies: who decides what is executed."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from lerobot_agpd.collect.rollout import Decision
from lerobot_agpd.guidance.alignment import Alignment
from lerobot_agpd.guidance.config import GuidanceConfig
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy, Discrepancy
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.guidance.teacher import DiffusionTeacher

Proposal = Callable[[Mapping[str, Tensor]], Tensor]
"""A student: raw observations (B, ...) to its chunk (B, S, A) in its own normalised space."""

DiscrepancyFactory = Callable[[Mapping[str, Tensor], Tensor, ActionDiscrepancy], Discrepancy]
"""Builds J from raw observations (B, ...), the student's chunk (B, S, A) and the action J of the same chunk."""


class TeacherAlone:
    """`replay`: the unguided teacher acts (policy distillation, PD)."""

    def __init__(self, teacher: DiffusionTeacher, n_steps: int, generator: torch.Generator):
        """Execute `n_steps` of every chunk; noise comes from `generator`."""
        self.teacher = teacher
        self.n_steps = n_steps
        self.generator = generator

    @property
    def n_obs_steps(self) -> int:
        """The teacher's history."""
        return self.teacher.n_obs_steps

    def decide(self, history: Mapping[str, Tensor], scale: Tensor) -> Decision:
        """The teacher's chunks; scales are ignored."""
        actions = self.teacher.sample(history, generator=self.generator)[:, : self.n_steps]
        nan = torch.full((len(actions),), float("nan"))
        return Decision(actions=actions, j=nan, shift=nan)


class GuidedTeacher:
    """`guided`: the teacher denoises, pulled toward the chunk that the student proposes (AGPD, Eq. 19-20)."""

    def __init__(
        self,
        teacher: DiffusionTeacher,
        propose: Proposal,
        alignment: Alignment,
        config: GuidanceConfig,
        generator: torch.Generator,
        make_discrepancy: DiscrepancyFactory | None = None,
    ):
        """Guide by the action J, or by what `make_discrepancy` builds."""
        self.teacher = teacher
        self.propose = propose
        self.alignment = alignment
        self.config = config
        self.generator = generator
        self.make_discrepancy = make_discrepancy

    @property
    def n_obs_steps(self) -> int:
        """The teacher's history."""
        return self.teacher.n_obs_steps

    def decide(self, history: Mapping[str, Tensor], scale: Tensor) -> Decision:
        """Guided chunks; rows with scale 0 are the teacher's own."""
        current = {key: value[:, -1] for key, value in history.items()}
        chunk_hat = self.propose(current)  # (B, S, A), student-normalised
        action_j = ActionDiscrepancy(self.alignment.student_in_teacher_units(chunk_hat), self.alignment.start)
        discrepancy = (
            self.make_discrepancy(current, chunk_hat, action_j) if self.make_discrepancy else action_j
        )
        guide = Guide(
            discrepancy,
            scale.to(chunk_hat.device),
            at=self.config.at,
            trust_region=self.config.trust_region,
        )
        actions = self.teacher.sample(history, guide, self.generator)[:, : self.alignment.n_steps]
        gap = self.alignment.teacher_units(actions) - action_j.target
        shift = torch.stack(guide.shift_in_sigmas).mean(dim=0) if guide.shift_in_sigmas else scale
        return Decision(
            actions=actions,
            j=0.5 * gap.square().sum(dim=(1, 2)),
            shift=torch.where(scale.to(shift) > 0, shift, torch.nan),
        )
