"""Kept episodes as a LeRobotDataset with the demonstrations' features."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.io_utils import load_info
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import DONE, OBS_PREFIX
from lerobot.utils.utils import is_valid_numpy_dtype_string

from lerobot_agpd.dataset_writer import DatasetWriter
from lerobot_agpd.replay.card import card_options, write_card
from lerobot_agpd.replay.episode import Array
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.replay.stored import StoredEpisode

logger = logging.getLogger(__name__)

MERGED = "merged"

ORIGIN_FEATURES: Mapping[str, dict[str, Any]] = {
    "agpd.round": {"dtype": "int64", "shape": (1,), "names": None},
    "agpd.strength": {"dtype": "float32", "shape": (1,), "names": None},
    "agpd.strategy": {"dtype": "string", "shape": (1,), "names": None},
}
"""Where a frame comes from: the collection round, the episode's strength, the strategy that acted."""

CAMERAS = ("image", "video")
"""Dtypes of camera features."""

Feature = Mapping[str, Any]


def merge(root: Path, repo_id: str | None = None) -> LeRobotDataset | None:
    """Write all kept episodes of a journal as one LeRobotDataset to `<root>/merged`.

    Every feature of the demonstrations that the environment delivers is in it, and `ORIGIN_FEATURES`. An earlier
    merged dataset is replaced. The journal is only read, so a run may go on collecting meanwhile.

    Args:
        root: folder of the journal.
        repo_id: name of the dataset; default: after the run's folder.

    Returns:
        The dataset; None if there is no kept episode.

    Raises:
        ValueError: if the journal is damaged, an episode does not fit the demonstrations, or `merged` is not a
            dataset written by this function.
    """
    journal = EpisodeJournal(root)
    merged, fresh, replaced = (root / f"{MERGED}{suffix}" for suffix in ("", ".new", ".replaced"))
    for folder in (merged, fresh, replaced):  # the last two are what a killed merge leaves
        _check_replaceable(folder)
    episodes = iter(journal.stored())
    first = next(episodes, None)
    if first is None:
        return None
    shutil.rmtree(fresh, ignore_errors=True)
    features = _merged_features(journal, first)
    writer = DatasetWriter(
        root=fresh,
        repo_id=repo_id or f"agpd/{root.resolve().parent.name}",
        fps=journal.header["fps"],
        features=features,
        robot_type=journal.header["robot_type"],
        use_videos=any(feature["dtype"] == "video" for feature in features.values()),
    )
    writer.write(_frames(journal, features, *stored) for stored in (first, *episodes))
    shutil.rmtree(replaced, ignore_errors=True)
    if merged.exists():
        merged.rename(replaced)
    fresh.rename(merged)
    shutil.rmtree(replaced, ignore_errors=True)
    dataset = LeRobotDataset(writer.repo_id, root=merged)
    write_card(dataset, journal)
    return dataset


def upload(dataset: LeRobotDataset, root: Path) -> None:
    """Push a merged dataset to the Hub, with a card that tells how the journal at `root` came about."""
    dataset.push_to_hub(**card_options(EpisodeJournal(root)))


def _check_replaceable(merged: Path) -> None:
    if not merged.exists():
        return
    try:
        is_ours = set(ORIGIN_FEATURES) <= set(load_info(merged).features)
    except (OSError, ValueError, KeyError, TypeError):
        is_ours = False
    if not is_ours:
        raise ValueError(
            f"{merged} exists and is not a dataset of merged episodes; move it away, then merge with "
            f"lerobot-agpd-merge --root={merged.parent}"
        )


def check_observation(features: Mapping[str, Feature], observation: Mapping[str, Array]) -> None:
    """Refuse an environment whose observations do not fit the demonstrations.

    Args:
        features: the demonstrations'.
        observation: that of one step, vectors (D,) and images (H, W, C).

    Raises:
        ValueError: if a value has another shape than in the demonstrations.
    """
    for key, value in observation.items():
        if key in features and value.shape not in _shapes(features[key]):
            raise ValueError(
                f"the environment delivers '{key}' with shape {value.shape}, the demonstrations hold "
                f"{tuple(features[key]['shape'])}; record both with the same observation settings (--env.*)"
            )


def _columns(journal: EpisodeJournal, round_number: int, episode: StoredEpisode) -> dict[str, Any]:
    """All columns (T, ...) of a merged episode, and a list of T strategies."""
    n_steps, record = len(episode), episode.record
    columns: dict[str, Any] = {key: episode.column(key) for key in episode.keys}
    columns = {key: values[:, None] if values.ndim == 1 else values for key, values in columns.items()}
    teacher_only = record.strength == 0 and record.student_steps == 0
    strategy = "teacher" if teacher_only else str(journal.header["identity"].get("strategy", "unknown"))
    return {
        **columns,
        DONE: np.arange(n_steps)[:, None] == n_steps - 1,
        "agpd.round": np.full((n_steps, 1), round_number, dtype=np.int64),
        "agpd.strength": np.full((n_steps, 1), record.strength, dtype=np.float32),
        "agpd.strategy": [strategy] * n_steps,
    }


def _merged_features(journal: EpisodeJournal, first: tuple[int, StoredEpisode]) -> dict[str, dict[str, Any]]:
    """The features of the merged dataset, as the first episode has them.

    Columns take over the demonstrations' dtype, unless it would cut off what was recorded (a float32 reward beside
    integers): those stay as they are. Images may be declared (H, W, C) or (C, H, W), as LeRobot allows.
    """
    columns = _columns(journal, *first)
    chosen: dict[str, dict[str, Any]] = {}
    for key, feature in journal.header["features"].items():
        if key in ORIGIN_FEATURES:
            continue
        if key in columns:
            chosen[key] = {
                **feature,
                "shape": tuple(feature["shape"]),
                "dtype": _dtype(feature, columns[key]),
            }
        elif key.startswith(OBS_PREFIX):  # no policy reads the others
            logger.warning("collected episodes lack the demonstrations' feature '%s'", key)
    return chosen | {key: dict(feature) for key, feature in ORIGIN_FEATURES.items()}


def _frames(
    journal: EpisodeJournal, features: Mapping[str, Feature], round_number: int, episode: StoredEpisode
) -> Iterator[dict[str, Any]]:
    """The frames of a merged episode, with its task."""
    columns = _columns(journal, round_number, episode)
    check_observation(features, {key: columns[key][0] for key in features if key.startswith(OBS_PREFIX)})
    typed = {key: _cast(columns[key], feature) for key, feature in features.items()}
    for step in range(len(episode)):
        yield {**{key: column[step] for key, column in typed.items()}, "task": episode.task}


def _shapes(feature: Feature) -> list[tuple[int, ...]]:
    """Shapes that a recorded value of a feature may have: images (H, W, C), however they are declared."""
    declared = tuple(feature["shape"])
    if feature["dtype"] not in CAMERAS:
        return [declared]
    channels, height, width = declared
    return [declared, (height, width, channels)]


def _dtype(feature: Feature, column: Array) -> str:
    """The dtype to write a recorded column with."""
    declared = feature["dtype"]
    if declared in CAMERAS:
        return declared
    holds = is_valid_numpy_dtype_string(declared) and np.can_cast(column.dtype, declared, "same_kind")
    return declared if holds else column.dtype.name


def _cast(column: Any, feature: Feature) -> Any:
    """A column as LeRobot expects it; images and strings stay as they are."""
    dtype = feature["dtype"]
    return np.asarray(column).astype(dtype) if is_valid_numpy_dtype_string(dtype) else column
