"""A student and a teacher put together: the guided teacher that collects, and that recordings show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.collect.strategies import GuidedTeacher
from lerobot_agpd.guidance.alignment import Alignment
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy, StateDiscrepancy
from lerobot_agpd.guidance.teacher import DiffusionTeacher
from lerobot_agpd.replay.normalisation import Normaliser

if TYPE_CHECKING:
    from lerobot_agpd.distill.student import DistilledStudent


@dataclass(frozen=True)
class Proposer:
    """A student seen from outside: raw observations in, chunks out.

    Attributes:
        student: the policy; in eval mode when it proposes.
        normaliser: the statistics it trains or was trained with.
    """

    student: DistilledStudent
    normaliser: Normaliser

    @property
    def config(self) -> Any:
        """The student's configuration."""
        return self.student.config

    def propose(self, observation: Mapping[str, Tensor]) -> Tensor:
        """The chunk A_hat (B, S, A) at raw observations, in the student's normalised space (Eq. 19)."""
        batch = {
            key: self.normaliser.normalise(key, observation[key]).to(self.config.device)
            for key in self.config.input_features
        }
        return self.student.predict_action_chunk(batch)

    def alignment_with(self, teacher: DiffusionTeacher) -> Alignment:
        """Which steps of the two policies' chunks belong together, and how to convert them."""
        return Alignment(
            start=teacher.start,
            n_steps=executed_steps(self.config, teacher),
            teacher_units=teacher.to_units,
            teacher_raw=teacher.to_raw,
            student_units=partial(self.normaliser.normalise, ACTION),
            student_raw=partial(self.normaliser.unnormalise, ACTION),
        )

    def guided(self, teacher: DiffusionTeacher, generator: torch.Generator) -> GuidedTeacher:
        """The teacher, guided toward this student by the discrepancy its configuration names."""
        alignment = self.alignment_with(teacher)
        learned = self.student.representation is not None
        return GuidedTeacher(
            teacher,
            self.propose,
            alignment,
            self.config.guidance,
            generator,
            partial(self._state_discrepancy, alignment) if learned else None,
        )

    def _state_discrepancy(
        self,
        alignment: Alignment,
        observation: Mapping[str, Tensor],
        chunk_hat: Tensor,
        action_j: ActionDiscrepancy,
    ) -> StateDiscrepancy:
        """J between the futures that the student's representation predicts (A.4)."""
        assert self.student.representation is not None
        vectors = [key for key in self.config.input_features if key not in self.config.image_features]
        normalised = [self.normaliser.normalise(key, observation[key]) for key in vectors]
        return StateDiscrepancy(
            representation=self.student.representation,
            observation=torch.cat(normalised, dim=1).to(chunk_hat.device),
            target=chunk_hat[:, : alignment.n_steps],
            to_student=alignment.teacher_in_student_units,
            reference=action_j,
        )


def executed_steps(config: Any, teacher: DiffusionTeacher) -> int:
    """Steps n of a chunk that collection executes and compares.

    Raises:
        ValueError: if more are asked for than either policy predicts.
    """
    n_steps = config.collect.n_action_steps or min(config.n_action_steps, teacher.n_action_steps)
    limit = min(config.chunk_size, teacher.n_chunk_steps)
    if n_steps > limit:
        raise ValueError(
            f"--policy.collect.n_action_steps={n_steps} exceeds what both policies predict from the current step "
            f"on: the student {config.chunk_size} (--policy.chunk_size), the teacher {teacher.n_chunk_steps}"
        )
    return n_steps
