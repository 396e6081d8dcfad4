"""Kept episodes as a LeRobotDataset with the demonstrations' features."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DEFAULT_FEATURES, DONE, OBS_PREFIX, REWARD, SUCCESS

from lerobot_agpd.replay.episode import Array, Episode

logger = logging.getLogger(__name__)

ROUND_FEATURES: Mapping[str, dict[str, Any]] = {
    "agpd.round": {"dtype": "int64", "shape": (1,), "names": None},
    "agpd.scale": {"dtype": "float32", "shape": (1,), "names": None},
    "agpd.strategy": {"dtype": "string", "shape": (1,), "names": None},
}
"""Where a frame comes from: the collection round, the episode's guidance scale, the strategy."""

OUTCOMES = (REWARD, SUCCESS, DONE)


class EpisodeWriter:
    """Writes episodes with every feature of the demonstrations that an environment can deliver."""

    def __init__(self, demonstrations: LeRobotDatasetMetadata):
        """Take over features, fps, robot type and task of the demonstrations."""
        self.demonstrations = demonstrations

    def features(self, episode: Episode) -> dict[str, dict[str, Any]]:
        """The features of a collected dataset.

        Raises:
            ValueError: if an observation has another shape than in the demonstrations.
        """
        chosen = {}
        for key, feature in self.demonstrations.features.items():
            if key in DEFAULT_FEATURES:
                continue
            if key in episode.observations:
                self._check_shape(key, feature, episode.observations[key])
            elif key not in (ACTION, *OUTCOMES) or (key == SUCCESS and episode.successes is None):
                if key.startswith(
                    OBS_PREFIX
                ):  # what else was noted down with the demonstrations, no policy reads
                    logger.warning("collected episodes lack the demonstrations' feature '%s'", key)
                continue
            chosen[key] = dict(feature)
        return {**chosen, **{key: dict(feature) for key, feature in ROUND_FEATURES.items()}}

    def _check_shape(self, key: str, feature: Mapping[str, Any], values: Array) -> None:
        if tuple(feature["shape"]) != values.shape[1:]:
            raise ValueError(
                f"the environment delivers '{key}' with shape {values.shape[1:]}, the demonstrations hold "
                f"{tuple(feature['shape'])}; record both with the same observation settings (--env.*)"
            )

    def write(self, root: Path, episodes: Sequence[Episode], number: int, strategy: str) -> None:
        """Write and finalise a dataset of at least one episode in a new folder."""
        features = self.features(episodes[0])
        dataset = LeRobotDataset.create(
            repo_id=f"agpd/{root.parent.name}-{root.name}",
            fps=self.demonstrations.fps,
            features=features,
            root=root,
            robot_type=self.demonstrations.robot_type,
            use_videos=bool(self.demonstrations.video_keys),
        )
        for episode in episodes:
            columns = self._columns(episode, number, strategy)
            for step in range(len(episode)):
                frame = {key: columns[key][step] for key in features}
                dataset.add_frame({**frame, "task": episode.task or self._task()})
            dataset.save_episode()
        dataset.finalize()

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
