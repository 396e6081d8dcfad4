"""Kept episodes as a LeRobotDataset with the demonstrations' features."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DONE, OBS_PREFIX, REWARD, SUCCESS
from lerobot.utils.utils import is_valid_numpy_dtype_string

from lerobot_agpd.replay.episode import Array, Episode

logger = logging.getLogger(__name__)

ROUND_FEATURES: Mapping[str, dict[str, Any]] = {
    "agpd.round": {"dtype": "int64", "shape": (1,), "names": None},
    "agpd.scale": {"dtype": "float32", "shape": (1,), "names": None},
    "agpd.strategy": {"dtype": "string", "shape": (1,), "names": None},
}
"""Where a frame comes from: the collection round, the episode's guidance scale, the strategy."""

CAMERAS = ("image", "video")
"""Dtypes of camera features."""


class EpisodeWriter:
    """Writes episodes with every feature of the demonstrations that an environment can deliver.

    Columns take over the demonstrations' dtype, unless it would cut off what was recorded (a float32 reward beside
    integers): those stay as they are. Images may be declared (H, W, C) or (C, H, W), as LeRobot allows.
    """

    def __init__(self, demonstrations: LeRobotDatasetMetadata):
        """Take over features, fps, robot type and task of the demonstrations."""
        self.demonstrations = demonstrations

    def check(self, observation: Mapping[str, Array]) -> None:
        """Refuse an environment whose observations could not be written.

        Args:
            observation: those of one step, vectors (D,) and images (H, W, C).

        Raises:
            ValueError: if one has another shape than in the demonstrations.
        """
        for key, value in observation.items():
            feature = self.demonstrations.features.get(key)
            if feature is not None and value.shape not in _shapes(feature):
                raise ValueError(
                    f"the environment delivers '{key}' with shape {value.shape}, the demonstrations hold "
                    f"{tuple(feature['shape'])}; record both with the same observation settings (--env.*)"
                )

    def features(self, columns: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """The features of a collected dataset with these columns."""
        chosen: dict[str, dict[str, Any]] = {}
        for key, feature in self.demonstrations.features.items():
            if key in ROUND_FEATURES:
                continue
            if key in columns:
                chosen[key] = {**feature, "dtype": _dtype(feature, columns[key])}
            elif key.startswith(OBS_PREFIX):  # whatever else was noted down, no policy reads
                logger.warning("collected episodes lack the demonstrations' feature '%s'", key)
        return {**chosen, **{key: dict(feature) for key, feature in ROUND_FEATURES.items()}}

    def write(self, root: Path, episodes: Iterable[Episode], number: int, strategy: str) -> None:
        """Write and finalise a dataset of at least one episode in a new folder; episodes are taken one by one.

        Raises:
            ValueError: if an observation has another shape than in the demonstrations.
        """
        dataset: LeRobotDataset | None = None
        for episode in episodes:
            columns = self._columns(episode, number, strategy)
            if dataset is None:
                self.check({key: values[0] for key, values in episode.observations.items()})
                features = self.features(columns)
                dataset = self._create(root, features)
            typed = {key: _cast(columns[key], feature) for key, feature in features.items()}
            for step in range(len(episode)):
                frame = {key: column[step] for key, column in typed.items()}
                dataset.add_frame({**frame, "task": episode.task or self._task()})
            dataset.save_episode()
        assert dataset is not None
        dataset.finalize()

    def _create(self, root: Path, features: dict[str, dict[str, Any]]) -> LeRobotDataset:
        return LeRobotDataset.create(
            repo_id=f"agpd/{root.parent.name}-{root.name}",
            fps=self.demonstrations.fps,
            features=features,
            root=root,
            robot_type=self.demonstrations.robot_type,
            use_videos=bool(self.demonstrations.video_keys),
        )

    def _columns(self, episode: Episode, number: int, strategy: str) -> dict[str, Any]:
        n_steps = len(episode)
        done = np.zeros((n_steps, 1), dtype=bool)
        done[-1] = True
        teacher_alone = not episode.ticket.guided and episode.student_steps == 0
        columns: dict[str, Any] = {
            **episode.observations,
            ACTION: episode.actions,
            REWARD: episode.rewards[:, None],
            DONE: done,
            "agpd.round": np.full((n_steps, 1), number, dtype=np.int64),
            "agpd.scale": np.full((n_steps, 1), episode.ticket.scale, dtype=np.float32),
            "agpd.strategy": ["replay" if teacher_alone else strategy] * n_steps,
        }
        if episode.successes is not None:
            columns[SUCCESS] = episode.successes[:, None]
        return columns

    def _task(self) -> str:
        return str(self.demonstrations.tasks.index[0])


def _shapes(feature: Mapping[str, Any]) -> list[tuple[int, ...]]:
    """Shapes that a recorded value of a feature may have: images (H, W, C), however they are declared."""
    declared = tuple(feature["shape"])
    if feature["dtype"] not in CAMERAS:
        return [declared]
    channels, height, width = declared
    return [declared, (height, width, channels)]


def _dtype(feature: Mapping[str, Any], column: Array) -> str:
    """The dtype to write a recorded column with."""
    declared = feature["dtype"]
    if declared in CAMERAS:
        return declared
    holds = is_valid_numpy_dtype_string(declared) and np.can_cast(column.dtype, declared, "same_kind")
    return declared if holds else column.dtype.name


def _cast(column: Any, feature: Mapping[str, Any]) -> Any:
    """A column as LeRobot wants it; images and strings are left alone."""
    dtype = feature["dtype"]
    return column.astype(dtype, copy=False) if is_valid_numpy_dtype_string(dtype) else column
