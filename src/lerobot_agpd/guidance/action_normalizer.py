"""A teacher's normalized action space: where its denoising happens, and J compares chunks."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import NormalizerProcessorStep
from torch import Tensor

LEAST_UNIT = 1e-6
"""Raw size of a normalized unit below which a dimension counts as constant."""


class ActionNormalizer:
    """Raw actions in the units of a checkpoint's normalizer.

    A dimension that never varied in the teacher's data (an unused gripper) is the constant it has there, whatever it
    is given: LeRobot divides it by 1e-8, so a student's rounding error would outweigh all other dimensions in J.

    Args:
        normalizer: of the checkpoint's preprocessor.
        action_dim: dimensions A of an action.
    """

    def __init__(self, normalizer: NormalizerProcessorStep, action_dim: int):
        self._normalizer = normalizer
        self._ends = torch.tensor([[0.0], [1.0]]).expand(2, action_dim)
        self._varies: Tensor | None = None
        mode = normalizer.norm_map.get(FeatureType.ACTION)
        self._constant = (
            0.0 if mode == NormalizationMode.MEAN_STD else -1.0
        )  # what LeRobot makes of the only value

    def normalize(self, actions_raw: Tensor) -> Tensor:
        """Raw actions (..., A) in the normalized space."""
        if self._varies is None or self._varies.device != actions_raw.device:
            low, high = self._normalized(self._ends.to(actions_raw))
            self._varies = (high - low).abs() < 1 / LEAST_UNIT  # (A,)
        return self._normalized(actions_raw).where(self._varies, self._constant)

    def _normalized(self, actions_raw: Tensor) -> Any:
        return self._normalizer({TransitionKey.ACTION: actions_raw})[TransitionKey.ACTION]
