"""Normalization of gathered frames with the very statistics that the training loop's preprocessor uses."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.lerobot_types import TransitionKey
from lerobot.policies import make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep, UnnormalizerProcessorStep
from lerobot.utils.constants import ACTION
from torch import Tensor

logger = logging.getLogger(__name__)

Statistics = Mapping[str, Mapping[str, Any]]

STD_FLOOR = 1e-3
"""Smallest standard deviation (and half of the smallest min-max range) a normalizer divides by, in the
feature's own unit. LeRobot's own floor of 1e-8 turns rounding errors of constant features into huge inputs."""


def floor_statistics(stats: Statistics, floor: float = STD_FLOOR) -> dict[str, dict[str, Any]]:
    """Copy of dataset statistics whose spread never falls below a floor.

    A feature that hardly varies is centered as before and divided by `floor` (MEAN_STD), or its range is
    widened to 2 * floor around its center (MIN_MAX).
    """
    floored = {key: dict(deepcopy(entry)) for key, entry in stats.items()}
    for entry in floored.values():
        if "std" in entry:
            entry["std"] = torch.as_tensor(entry["std"]).clamp_min(floor)
        if "min" in entry and "max" in entry:
            low, high = torch.as_tensor(entry["min"]), torch.as_tensor(entry["max"])
            widen = (2 * floor - (high - low)).clamp_min(0) / 2
            entry["min"], entry["max"] = low - widen, high + widen
    return floored


class Normalizer:
    """LeRobot's normalizer and unnormalizer for one set of statistics, usable on single features."""

    def __init__(self, config: PreTrainedConfig, stats: Statistics):
        """Normalize the features of `config` in the way its `normalization_mapping` says."""
        self.stats = stats
        arguments: dict[str, Any] = {
            "features": {**(config.input_features or {}), **(config.output_features or {})},
            "norm_map": getattr(config, "normalization_mapping"),  # noqa: B009  # every policy has one, not the base class
            "stats": {key: dict(entry) for key, entry in stats.items()},
        }
        self._normalize = NormalizerProcessorStep(**arguments)
        self._unnormalize = UnnormalizerProcessorStep(**arguments)

    def normalize(self, key: str, values: Tensor) -> Tensor:
        """Map values (..., D) of a feature from its own units to the policy's."""
        return self._apply(self._normalize, key, values)

    def unnormalize(self, key: str, values: Tensor) -> Tensor:
        """Map values (..., D) of a feature from the policy's units back to its own."""
        return self._apply(self._unnormalize, key, values)

    @staticmethod
    def _apply(step: Any, key: str, values: Tensor) -> Tensor:
        if key == ACTION:
            return step({TransitionKey.ACTION: values})[TransitionKey.ACTION]
        return step({TransitionKey.OBSERVATION: {key: values}})[TransitionKey.OBSERVATION][key]


def saved_statistics(pretrained_path: Path | str, config: PreTrainedConfig) -> Statistics | None:
    """Statistics stored with a checkpoint's preprocessor, or None where it has no normalizer."""
    preprocessor, _ = make_pre_post_processors(
        config,
        pretrained_path=str(pretrained_path),
        preprocessor_overrides={"device_processor": {"device": config.device}},
    )
    for step in preprocessor.steps:
        if isinstance(step, NormalizerProcessorStep):
            return step.stats
    return None


def matching_normalizer(
    config: PreTrainedConfig,
    candidates: Sequence[tuple[str, Statistics]],
    raw: Mapping[str, Tensor],
    delivered: Mapping[str, Tensor],
    tolerance: float = 1e-3,
) -> Normalizer:
    """The candidate statistics that turn `raw` frames into the ones the training loop `delivered`.

    LeRobot keeps a checkpoint's statistics when a run is resumed and replaces them with the dataset's when a
    policy is only started from it, and tells the policy neither. The data show which ones are in use.

    Args:
        config: features and normalization modes.
        candidates: named statistics, most likely first.
        raw: raw frames (B, D) per feature.
        delivered: the same frames as the loop's preprocessor normalized them.
        tolerance: largest difference, relative to max(1, |value|).

    Raises:
        ValueError: if none of the candidates explains what was delivered.
    """
    errors = {}
    for name, stats in candidates:
        normalizer = Normalizer(config, stats)
        errors[name] = {
            key: _relative_error(normalizer.normalize(key, raw[key]), delivered[key]) for key in raw
        }
        if all(error <= tolerance for error in errors[name].values()):  # which no NaN is
            logger.info("gathered frames are normalized with the %s statistics", name)
            return normalizer
    raise ValueError(
        "no known statistics reproduce the normalized frames that the training loop delivers; largest "
        f"relative errors: {errors}. Does a processor step other than normalization change low-dimensional "
        "features? Then train with frames delivered by LeRobot's loader instead of gathered ones."
    )


def _relative_error(ours: Tensor, theirs: Tensor) -> float:
    ours, theirs = ours.float().cpu(), theirs.float().cpu()
    return float(((ours - theirs).abs() / theirs.abs().clamp_min(1)).max())
