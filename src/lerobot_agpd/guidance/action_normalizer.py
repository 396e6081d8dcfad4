"""A teacher's normalized action space: where it denoises, and J compares chunks."""

from __future__ import annotations

from typing import cast

import torch
from lerobot.configs import FeatureType, NormalizationMode
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import NormalizerProcessorStep
from lerobot.processor.converters import create_transition
from torch import Tensor

LEAST_UNIT = 1e-6
"""Raw size of a normalized unit below which a dimension counts as constant."""


class ActionNormalizer:
    """Maps raw actions to the normalized space of a checkpoint.

    A dimension that never varied in the teacher's data (an unused gripper) always gets the value it has there:
    LeRobot divides it by 1e-8, so a student's rounding error would outweigh all other dimensions in J.

    Args:
        step: the normalizer of the checkpoint's preprocessor.
        action_dim: dimensions A of an action.
    """

    def __init__(self, step: NormalizerProcessorStep, action_dim: int):
        self._step = step
        self._ends = torch.tensor([[0.0], [1.0]]).expand(2, action_dim)
        self._varies: Tensor | None = None
        # LeRobot maps the only value of a constant dimension to 0 (its mean) or -1 (its minimum).
        mode = step.norm_map.get(FeatureType.ACTION)
        self._constant = 0.0 if mode == NormalizationMode.MEAN_STD else -1.0

    def normalize(self, actions_raw: Tensor) -> Tensor:
        """Map raw actions (..., A) to the normalized space."""
        if self._varies is None or self._varies.device != actions_raw.device:
            low, high = self._apply(self._ends.to(actions_raw))
            self._varies = (high - low).abs() < 1 / LEAST_UNIT  # (A,)
        return self._apply(actions_raw).where(self._varies, self._constant)

    def _apply(self, actions_raw: Tensor) -> Tensor:
        transition = dict(self._step(create_transition(action=actions_raw)))
        return cast(Tensor, transition[TransitionKey.ACTION])
