"""Normalization of gathered frames with the very statistics that the training loop's preprocessor uses."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import NormalizerProcessorStep, UnnormalizerProcessorStep
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.trust import load_processors

logger = logging.getLogger(__name__)

Statistics = Mapping[str, Mapping[str, Any]]

STD_FLOOR = 1e-3
"""Smallest standard deviation (and half of the smallest min-max range) a normalizer divides by, in the
feature's own unit. LeRobot's own floor of 1e-8 turns rounding errors of constant features into huge inputs."""


RANGES = (("min", "max"), ("q01", "q99"), ("q10", "q90"))
"""Statistics that a feature is mapped to [-1, 1] by."""


def training_statistics(config: PreTrainedConfig, stats: Statistics) -> dict[str, dict[str, Any]]:
    """Statistics that a policy trains with: the dataset's, floored.

    Action dimensions that hardly vary in the demonstrations (a gripper that stays open) are scaled by what the
    teacher's own data hold there, if there is a teacher: what it does with them in T would otherwise be thousands of
    standard deviations off, and outweigh all other dimensions in the losses.
    """
    action = stats.get(ACTION)
    if not isinstance(config, StudentConfig) or not config.teacher.path or not config.uses_teacher:
        return floor_statistics(stats)
    if not action or not _hardly_varies(action):
        return floor_statistics(stats)
    of_teacher = _teacher_statistics(config.teacher.path).get(ACTION, {})
    return floor_statistics({**stats, ACTION: _widened(action, of_teacher)})


def floor_statistics(stats: Statistics, floor: float = STD_FLOOR) -> dict[str, dict[str, Any]]:
    """Copy of dataset statistics whose spread never falls below a floor.

    A feature that hardly varies is centered as before and divided by `floor` (MEAN_STD), or its range is
    widened to 2 * floor around its center (MIN_MAX); a narrow range of quantiles becomes that from min to max first.
    """
    floored = {key: dict(deepcopy(entry)) for key, entry in stats.items()}
    for entry in floored.values():
        if "std" in entry:
            entry["std"] = torch.as_tensor(entry["std"]).clamp_min(floor)
        for low_name, high_name in _ranges(entry):
            low, high = torch.as_tensor(entry[low_name]), torch.as_tensor(entry[high_name])
            if "min" in entry and "max" in entry:
                narrow = high - low < 2 * floor
                low = torch.where(narrow, torch.as_tensor(entry["min"]), low)
                high = torch.where(narrow, torch.as_tensor(entry["max"]), high)
            widen = (2 * floor - (high - low)).clamp_min(0) / 2
            entry[low_name], entry[high_name] = low - widen, high + widen
    return floored


def _ranges(entry: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(low, high) for low, high in RANGES if low in entry and high in entry]


def _hardly_varies(entry: Mapping[str, Any]) -> bool:
    """Whether any dimension's spread is below the floor."""
    narrow = [torch.as_tensor(entry["std"]) < STD_FLOOR] if "std" in entry else []
    narrow += [
        torch.as_tensor(entry[high]) - torch.as_tensor(entry[low]) < 2 * STD_FLOOR
        for low, high in _ranges(entry)
    ]
    return any(bool(dimensions.any()) for dimensions in narrow)


def _widened(entry: Mapping[str, Any], of_teacher: Mapping[str, Any]) -> dict[str, Any]:
    """Statistics (A,) whose dimensions of hardly any spread take in what the teacher's data hold."""
    widened = dict(entry)
    if {"mean", "std"} <= of_teacher.keys() & entry.keys():
        mean, std = (torch.as_tensor(entry[name]) for name in ("mean", "std"))
        distance = torch.as_tensor(of_teacher["mean"]).to(mean) - mean
        held = torch.hypot(
            torch.as_tensor(of_teacher["std"]).to(mean), distance
        )  # around the demonstrations' mean
        widened["std"] = torch.where(std < STD_FLOOR, torch.maximum(std, held), std)
    for low_name, high_name in _ranges(entry):
        if low_name in of_teacher and high_name in of_teacher:
            low, high = torch.as_tensor(entry[low_name]), torch.as_tensor(entry[high_name])
            narrow = high - low < 2 * STD_FLOOR
            below = torch.minimum(low, torch.as_tensor(of_teacher[low_name]).to(low))
            above = torch.maximum(high, torch.as_tensor(of_teacher[high_name]).to(high))
            widened[low_name] = torch.where(narrow, below, low)
            widened[high_name] = torch.where(narrow, above, high)
    return widened


@lru_cache(maxsize=1)
def _teacher_statistics(path: str) -> Statistics:
    """Statistics that a checkpoint normalizes with."""
    config = PreTrainedConfig.from_pretrained(path)
    config.device = "cpu"
    return saved_statistics(path, config) or {}


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
    preprocessor, _ = load_processors(pretrained_path, config)
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
