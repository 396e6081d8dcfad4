"""What may enter T: numbers that are finite, and on the scale that the student trains with."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from torch import Tensor

from lerobot_agpd.flag_checks import require
from lerobot_agpd.replay.episode import Array
from lerobot_agpd.replay.frames import FrameTable

logger = logging.getLogger(__name__)

FAR = 50.0
"""Normalized values beyond this are warned of: one of them outweighs a batch of ordinary ones."""


# ---- demonstrations ----


def require_finite_frames(table: FrameTable, repo_id: str) -> None:
    """Refuse demonstrations that hold NaN or infinite values.

    Raises:
        FlagError: naming the first such value by feature, episode and frame, and how many frames have more.
    """
    bad = {key: (~torch.isfinite(values)).flatten(1).any(dim=1) for key, values in table.columns.items()}
    n_frames = int(torch.stack(list(bad.values())).any(dim=0).sum())
    for key, frames in bad.items():
        index = frames.nonzero()[:1, 0]
        if len(index):
            episode, frame = int(table.episode(index)), int(index - table.episode_bounds(index)[0])
            value = table.columns[key][index]
            require(
                False,
                f"--dataset.repo_id={repo_id}: '{key}' is not finite in episode {episode}, frame {frame} "
                f"({value[~torch.isfinite(value)][0].item()}; {n_frames} of {len(table)} frames have such a value); "
                "repair the dataset, or remove its episode with lerobot-edit-dataset "
                "--operation.type=delete_episodes",
            )


def require_statistics(
    stats: Mapping[str, Mapping[str, Any]] | None,
    config: PreTrainedConfig,
    keys: Iterable[str],
    repo_id: str,
) -> None:
    """Refuse missing statistics of features that are to be normalized, and statistics that are not finite.

    Args:
        stats: of the dataset.
        config: the policy's.
        keys: features that must have statistics.
        repo_id: of the dataset.

    Raises:
        FlagError: naming the feature and what to do.
    """
    modes: Mapping[str, NormalizationMode] = getattr(config, "normalization_mapping", {})
    features = {**(config.input_features or {}), **(config.output_features or {})}
    remedy = f"compute them with lerobot-edit-dataset --repo_id={repo_id} --operation.type=recompute_stats"
    missing = [
        key
        for key in keys
        if not (stats or {}).get(key)
        and modes.get(features[key].type.value) not in (None, NormalizationMode.IDENTITY)
    ]
    require(
        not missing,
        f"--dataset.repo_id={repo_id} has no statistics of {missing} (meta/stats.json), and the policy would train on "
        f"values that are not normalized; {remedy}",
    )
    bad = not_finite_statistic({key: entry for key, entry in (stats or {}).items() if key in features})
    require(
        bad is None,
        f"--dataset.repo_id={repo_id}: the statistic {bad} (meta/stats.json) is not finite; {remedy}",
    )


def not_finite_statistic(stats: Mapping[str, Mapping[str, Any]]) -> str | None:
    """The first statistic with a value that is not finite, as "'name' of 'feature'"."""
    for key, entry in stats.items():
        for name, value in entry.items():
            if not np.isfinite(np.asarray(value, dtype=np.float64)).all():
                return f"'{name}' of '{key}'"
    return None


# ---- collected episodes ----


def first_not_finite(columns: Mapping[str, Array]) -> str | None:
    """Where columns (T, ...) first hold a value that is not finite, as "'feature' at step n"; None if nowhere."""
    found: dict[str, int] = {}
    for key, values in columns.items():
        if np.issubdtype(values.dtype, np.floating):
            steps = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
            if len(steps):
                found[key] = int(steps[0])
    if not found:
        return None
    key = min(found, key=lambda name: found[name])
    return f"'{key}' at step {found[key]}"


class FarValues:
    """Warns, once per feature, of values far outside what the student's normalization expects."""

    def __init__(self) -> None:
        self._warned: set[str] = set()

    def check(self, source: str, key: str, values: Tensor) -> None:
        """Look at values (..., D) of a feature, normalized by the student's statistics; `source` holds them."""
        if key in self._warned or not values.numel():
            return
        farthest = values.detach().abs().flatten(0, -2).amax(dim=0)  # (D,)
        dimension = int(farthest.argmax())
        if farthest[dimension] > FAR:
            self._warned.add(key)
            logger.warning(
                "%s: dimension %d of '%s' lies up to %.0f normalized units (standard deviations) from what the "
                "demonstrations hold, and such values drown all others in training; do the demonstrations lack this "
                "motion, or are its units others?",
                source,
                dimension,
                key,
                farthest[dimension],
            )
