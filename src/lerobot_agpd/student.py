"""What the algorithm needs of a student: a chunk, the prior chunk, an embedding of the observation, a snapshot."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.flag_checks import FlagError, require
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy, StateDiscrepancy
from lerobot_agpd.guidance.representation import StateRepresentation
from lerobot_agpd.guidance.teacher import History, Teacher
from lerobot_agpd.guidance.teacher_student import TeacherStudent
from lerobot_agpd.guidance.visual import VisualEncoder
from lerobot_agpd.replay.normalization import Normalizer


@dataclass(frozen=True)
class PriorChunk:
    """What the discriminator sees of the student at a batch of observations.

    Attributes:
        chunk: (B, S, A) from the current step on, in the student's normalized space, with gradients.
        embedding: (B, E) of the observations.
    """

    chunk: Tensor
    embedding: Tensor


class Student(nn.Module):
    """Interface of a LeRobot policy that can be trained by AGPD.

    Attributes:
        config: its configuration.
        representation: predicts future observations for J (A.4); None where J compares the chunks themselves.
        visual_encoder: makes what it predicts of camera images; None where it predicts low-dimensional observations.
        can_teach_itself: whether `snapshot` is implemented.
    """

    config: StudentConfig
    representation: StateRepresentation | None
    visual_encoder: VisualEncoder | None = None
    can_teach_itself = False

    if TYPE_CHECKING:

        def predict_action_chunk(self, batch: dict[str, Tensor]) -> Tensor: ...  # noqa: D102

        def reset(self) -> None: ...  # noqa: D102

    @property
    @abstractmethod
    def embedding_dim(self) -> int:
        """Size E of the observation embedding in a PriorChunk."""

    @abstractmethod
    def prior_chunk(self, batch: Mapping[str, Tensor]) -> PriorChunk:
        """The student's chunk as the discriminator sees it, and an embedding of the observation.

        For a policy that predicts in one pass this is the chunk that would be executed, and must not look at the
        recorded actions (ACT in training mode does). A policy that denoises returns the clean chunk that one
        denoising step estimates, so that nothing is backpropagated through its sampling.
        """

    def image_tokens(self, images: Mapping[str, Tensor]) -> Tensor:
        """The student's own features (B, N, F) of the cameras' normalized images (B, C, H, W)."""
        raise FlagError(
            f"--policy.representation.encoder=student: a '{self.config.type}' student has no image features to offer; "
            "name a DINOv2"
        )

    def snapshot(self) -> PreTrainedPolicy:
        """A frozen copy of the policy as it would be evaluated now, without what only trains it."""
        raise NotImplementedError(
            f"a '{self.config.type}' policy cannot teach itself: set --policy.teacher.path"
        )


@dataclass(frozen=True)
class StudentSampler:
    """A student seen from outside: raw observations in, chunks out.

    Attributes:
        student: the policy in training, or a trained one.
        normalizer: the statistics it trains or was trained with.
        acting: the policy that proposes in its place, such as its previous self; default: the student.
    """

    student: Student
    normalizer: Normalizer
    acting: PreTrainedPolicy | None = None

    @property
    def config(self) -> StudentConfig:
        """The student's configuration."""
        return self.student.config

    def propose(self, history: History) -> Tensor:
        """The chunk A_hat (B, S, A) at raw observations (B, T, ...), in the student's normalized space (Eq. 19)."""
        policy = self.acting or self.student
        length = self.config.history_length
        batch = {}
        for key in self.config.input_features or {}:
            recent = history[key][:, -1] if length is None else history[key][:, -length:]
            batch[key] = self.normalizer.normalize(key, recent).to(self.config.device)
        policy.reset()  # with observations left in its queues, LeRobot's diffusion policy ignores the batch
        return policy.predict_action_chunk(batch)

    def pair_with(self, teacher: Teacher) -> TeacherStudent:
        """This student and a teacher, their chunks aligned."""
        learned = self.student.representation is not None
        return TeacherStudent(
            teacher=teacher,
            student=self.propose,
            n_steps=executed_steps(self.config, teacher),
            normalize=partial(self.normalizer.normalize, ACTION),
            unnormalize=partial(self.normalizer.unnormalize, ACTION),
            make_discrepancy=self._state_discrepancy if learned else None,
            student_n_obs_steps=self.config.history_length or 1,
        )

    def _state_discrepancy(
        self, pair: TeacherStudent, history: History, chunk_hat: Tensor, action_j: ActionDiscrepancy
    ) -> StateDiscrepancy:
        """J between the futures that the student's representation predicts (A.4)."""
        assert self.student.representation is not None
        return StateDiscrepancy(
            representation=self.student.representation,
            observation=self._observation(history).to(chunk_hat.device),
            target=chunk_hat[:, : pair.n_steps],
            to_student=pair.teacher_in_student_space,
            reference=action_j,
        )

    def _observation(self, history: History) -> Tensor:
        """What the representation is given of the present, (B, D)."""
        if self.student.visual_encoder is not None:
            images = {key: history[key][:, -1] for key in self.config.image_features}
            return self.student.visual_encoder.encode(images, self.normalizer.normalize)
        vectors = (
            self.normalizer.normalize(key, history[key][:, -1]) for key in self.config.observed_vectors
        )
        return torch.cat(list(vectors), dim=1)


def executed_steps(config: StudentConfig, teacher: Teacher | None) -> int:
    """Steps n of a chunk that collection executes and compares; without a teacher, the student's own.

    Raises:
        FlagError: if more are requested than either policy predicts.
    """
    own = config.n_execute
    n_steps = config.collect.n_action_steps or (min(own, teacher.n_action_steps) if teacher else own)
    predicted = {"the student": config.predicted_steps}
    if teacher:
        predicted["the teacher"] = teacher.n_chunk_steps
    require(
        n_steps <= min(predicted.values()),
        f"--policy.collect.n_action_steps={n_steps} exceeds what is predicted from the current step on: "
        + ", ".join(f"{name} {number}" for name, number in predicted.items()),
    )
    return n_steps
