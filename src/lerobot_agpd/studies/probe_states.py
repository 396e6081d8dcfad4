"""States of recorded episodes at which a teacher is probed."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.configs import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.gate import require_finite_frames
from lerobot_agpd.replay.images import RecordedFrames
from lerobot_agpd.student import StudentSampler


class RecordedStates:
    """States of a dataset at which a teacher is asked: starts of episodes first, then frames anywhere in them.

    Args:
        dataset: the demonstrations; all their frames or selected episodes.
        teacher: who observes them.
        student: who observes them too, or None.
        n_states: number of frames anywhere, and the largest number of starts.
        seed: of the choice.

    Attributes:
        index: (S,) frame numbers.
        is_start: (S,) whether a state is of the first group.
    """

    def __init__(
        self,
        dataset: LeRobotDataset,
        teacher: Teacher,
        student: StudentSampler | None,
        n_states: int,
        seed: int,
    ):
        features = dict(teacher.input_features)
        self.n_obs_steps = teacher.n_obs_steps
        if student is not None:
            features |= student.config.input_features or {}
            self.n_obs_steps = max(self.n_obs_steps, student.config.history_length or 1)
        self.keys = list(features)
        self.has_cameras = any(feature.type is FeatureType.VISUAL for feature in features.values())
        vectors = [key for key, feature in features.items() if feature.type is not FeatureType.VISUAL]
        table = FrameTable.from_dataset(dataset, vectors)
        require_finite_frames(table, dataset.repo_id)
        self._frames = RecordedFrames(dataset, table)
        self._table = table
        starts = torch.cat([torch.zeros(1, dtype=torch.long), table.lengths.cumsum(0)[:-1]])
        noise = torch.Generator().manual_seed(seed)
        chosen = starts[torch.randperm(len(starts), generator=noise)[:n_states].sort().values]
        anywhere = torch.randperm(len(table), generator=noise)[:n_states]
        self.index = torch.cat([chosen, anywhere])
        self.is_start = torch.arange(len(self.index)) < len(chosen)

    def __len__(self) -> int:
        """Number of states S."""
        return len(self.index)

    def history(self, states: Tensor) -> dict[str, Any]:
        """Raw observations (B, n_obs_steps, ...) of states (B,), counted from 0, and their tasks."""
        return self._frames.history(self.index[states], self.keys, self.n_obs_steps)

    def whereabouts(self) -> list[dict[str, int]]:
        """Episode and frame within it of every state."""
        first, _ = self._table.episode_bounds(self.index)
        episodes, frames = self._table.episode(self.index), self.index - first
        return [
            {"episode": episode, "frame": frame}
            for episode, frame in zip(episodes.tolist(), frames.tolist(), strict=True)
        ]
