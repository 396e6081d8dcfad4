"""A student and a teacher put together: what collects, and what recordings show."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.collect.decider import Decider
from lerobot_agpd.collect.deciders.pair import Pair
from lerobot_agpd.collect.deciders.teacher import GuidedTeacher
from lerobot_agpd.collect.strategies import make_decider
from lerobot_agpd.guidance.alignment import Alignment
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy, StateDiscrepancy
from lerobot_agpd.guidance.teacher import History, Teacher
from lerobot_agpd.replay.normalisation import Normaliser

if TYPE_CHECKING:
    from lerobot_agpd.distill.student import DistilledStudent


@dataclass(frozen=True)
class Proposer:
    """A student seen from outside: raw observations in, chunks out.

    Attributes:
        student: the policy in training, or a trained one.
        normaliser: the statistics it trains or was trained with.
        acting: who proposes in its place, such as its previous self; default: the student. In eval mode.
    """

    student: DistilledStudent
    normaliser: Normaliser
    acting: PreTrainedPolicy | None = None

    @property
    def config(self) -> Any:
        """The student's configuration."""
        return self.student.config

    @property
    def n_obs_steps(self) -> int:
        """Length of the observation history it needs."""
        return self.config.observation_history or 1

    def propose(self, history: History) -> Tensor:
        """The chunk A_hat (B, S, A) at raw observations (B, T, ...), in the student's normalised space (Eq. 19)."""
        policy: Any = self.acting or self.student
        batch = {}
        for key in self.config.input_features:
            recent = history[key][:, -self.n_obs_steps :]
            recent = recent[:, 0] if self.config.observation_history is None else recent
            batch[key] = self.normaliser.normalise(key, recent).to(self.config.device)
        policy.reset()  # with observations left in its queues, LeRobot's diffusion policy ignores the batch
        return policy.predict_action_chunk(batch)

    def alignment_with(self, teacher: Teacher) -> Alignment:
        """Which steps of the two policies' chunks belong together, and how to convert them."""
        return Alignment(
            start=teacher.start,
            n_steps=executed_steps(self.config, teacher),
            teacher_units=teacher.to_units,
            teacher_raw=teacher.to_raw,
            student_units=partial(self.normaliser.normalise, ACTION),
            student_raw=partial(self.normaliser.unnormalise, ACTION),
        )

    def pair(self, teacher: Teacher) -> Pair:
        """This student and a teacher, their chunks aligned."""
        alignment = self.alignment_with(teacher)
        learned = self.student.representation is not None
        make_discrepancy = partial(self._state_discrepancy, alignment) if learned else None
        return Pair(teacher, self.propose, alignment, make_discrepancy, self.n_obs_steps)

    def decider(self, teacher: Teacher, generator: torch.Generator) -> Decider:
        """The strategy of collection that the configuration names, for this student and a teacher."""
        return make_decider(self.config, self.pair(teacher), generator)

    def guided(self, teacher: Teacher, generator: torch.Generator) -> GuidedTeacher:
        """The teacher guided toward this student, whatever the configuration collects with."""
        return GuidedTeacher(self.pair(teacher), generator, self.config.guidance)

    def _state_discrepancy(
        self,
        alignment: Alignment,
        history: History,
        chunk_hat: Tensor,
        action_j: ActionDiscrepancy,
    ) -> StateDiscrepancy:
        """J between the futures that the student's representation predicts (A.4)."""
        assert self.student.representation is not None
        vectors = [key for key in self.config.input_features if key not in self.config.image_features]
        normalised = [self.normaliser.normalise(key, history[key][:, -1]) for key in vectors]
        return StateDiscrepancy(
            representation=self.student.representation,
            observation=torch.cat(normalised, dim=1).to(chunk_hat.device),
            target=chunk_hat[:, : alignment.n_steps],
            to_student=alignment.teacher_in_student_units,
            reference=action_j,
        )


def executed_steps(config: Any, teacher: Teacher | None) -> int:
    """Steps n of a chunk that collection executes and compares; without a teacher, the student's own.

    Raises:
        ValueError: if more are asked for than either policy predicts.
    """
    own = config.n_action_steps
    n_steps = config.collect.n_action_steps or (min(own, teacher.n_action_steps) if teacher else own)
    predicted = {"the student": config.predicted_steps}
    if teacher:
        predicted["the teacher"] = teacher.n_chunk_steps
    if n_steps > min(predicted.values()):
        raise ValueError(
            f"--policy.collect.n_action_steps={n_steps} exceeds what is predicted from the current step on: "
            + ", ".join(f"{who} {number}" for who, number in predicted.items())
        )
    return n_steps
