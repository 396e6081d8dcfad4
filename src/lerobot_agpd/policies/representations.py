"""The representation of J that `--policy.representation.*` asks for."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.flag_checks import FlagError, require
from lerobot_agpd.guidance.representation import StateRepresentation
from lerobot_agpd.guidance.visual import STUDENT, DinoEncoder, Normalize, VisualEncoder

if TYPE_CHECKING:
    from lerobot_agpd.student import Student

logger = logging.getLogger(__name__)


class StudentFeatures(VisualEncoder):
    """The image features of a student as it is now, without gradients: J on what it has learned to see.

    Args:
        student: implements `image_tokens`.
    """

    is_frozen = False

    def __init__(self, student: Student):
        self.student = student
        blank = {
            key: torch.zeros(1, *feature.shape) for key, feature in student.config.image_features.items()
        }
        with torch.no_grad():
            _, self.n_tokens, self.dim = self._tokens(blank, lambda key, images: images).shape

    def load(self) -> None:
        """Nothing: the student is there."""

    def _tokens(self, images: Mapping[str, Tensor], normalize: Normalize) -> Tensor:
        device = next(self.student.parameters()).device  # histories of a rollout are on the CPU
        images = {key: normalize(key, values).to(device) for key, values in images.items()}
        was_training = self.student.training
        self.student.eval()  # no random shifts
        try:
            return self.student.image_tokens(images)
        finally:
            self.student.train(was_training)


def make_representation(
    student: Student, is_trained: bool
) -> tuple[StateRepresentation | None, VisualEncoder | None]:
    """The representation of a student's configuration, and what makes features of images for it.

    Args:
        student: whose configuration counts.
        is_trained: whether it is built to be trained. A trained one acts without: where the encoder cannot be found, there
            is no representation.

    Raises:
        FlagError: if the student does not see what it needs, or the encoder cannot be found.
    """
    config = student.config
    if config.representation.type == "action":
        return None, None
    assert config.action_feature is not None
    action_dim, n_steps = config.action_feature.shape[0], config.collect.n_action_steps or config.n_execute
    if config.representation.type == "state":
        return StateRepresentation(_state_dim(config), action_dim, n_steps), None
    try:
        encoder = _visual_encoder(student)
    except FlagError as error:
        if is_trained:
            raise
        logger.warning("the student acts, but its discrepancy J cannot be computed: %s", error)
        return None, None
    dim = encoder.n_tokens * encoder.dim
    return StateRepresentation(dim, action_dim, n_steps, encoder.n_tokens), encoder


def _visual_encoder(student: Student) -> VisualEncoder:
    config = student.config
    cameras = tuple(config.image_features)
    require(
        bool(cameras),
        f"--policy.representation.type=visual predicts what cameras see, but the inputs are "
        f"{list(config.input_features or {})}; use --policy.representation.type=state or action",
    )
    if config.representation.encoder == STUDENT:
        return StudentFeatures(student)
    return DinoEncoder(config.representation.encoder, cameras, config.device or "cpu")


def _state_dim(config: StudentConfig) -> int:
    """Size D of all low-dimensional observations side by side."""
    features, cameras = config.input_features or {}, list(config.image_features)
    require(
        bool(config.observed_vectors),
        "--policy.representation.type=state predicts low-dimensional observations, but the inputs are "
        f"{list(features)}; use --policy.representation.type=action",
    )
    require(
        not cameras or config.env_state_feature is not None,
        f"--policy.representation.type=state would compare futures of {config.observed_vectors} alone, and the student sees "
        f"the cameras {cameras} too; use --policy.representation.type=visual or action",
    )
    return sum(features[key].shape[0] for key in config.observed_vectors)
