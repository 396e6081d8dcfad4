"""Camera frames and tasks of T, read where they were recorded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.stored import StoredEpisode


class RecordedFrames:
    """What the frames of T hold beside their columns.

    Args:
        dataset: the demonstrations, the first episodes of T.
        table: the columns of T, which grow.
    """

    def __init__(self, dataset: LeRobotDataset, table: FrameTable):
        self.dataset = dataset
        self.table = table
        self.n_demonstration_frames = len(table)
        self._n_demonstrations = len(table.lengths)
        self._tasks = _tasks(dataset)
        self._collected: list[StoredEpisode] = []

    def append(self, episode: StoredEpisode) -> None:
        """Add a collected episode, whose columns the table has."""
        self._collected.append(episode)

    def images(self, frame_index: Tensor, keys: Sequence[str]) -> dict[str, Tensor]:
        """Cameras' frames (B, C, H, W) in [0, 1]; each distinct frame is read once."""
        distinct, position = frame_index.cpu().unique(return_inverse=True)
        read = [self._read(index, keys) for index in distinct.tolist()]
        return {key: torch.stack([frames[key] for frames in read])[position] for key in keys}

    def _read(self, index: int, keys: Sequence[str]) -> dict[str, Tensor]:
        if index < self.n_demonstration_frames:
            item: Any = self.dataset[index]
            return {key: item[key] for key in keys}
        episode, step = self._locate(index)
        frames = {key: torch.from_numpy(episode.frame(key, step)) for key in keys}
        return {key: frame.permute(2, 0, 1).float() / 255 for key, frame in frames.items()}

    def task(self, index: int) -> str:
        """The task of a frame's episode."""
        if index < self.n_demonstration_frames:
            return self._tasks[index]
        return self._locate(index)[0].task

    def history(self, frame_index: Tensor, keys: Sequence[str], n_obs_steps: int) -> dict[str, Any]:
        """Raw observation histories (B, n_obs_steps, ...) of frames, and their `task`s; an episode's first frame repeats."""
        frame_index, deltas = frame_index.cpu(), torch.arange(1 - n_obs_steps, 1)
        histories: dict[str, Any] = {"task": [self.task(index) for index in frame_index.tolist()]}
        columns = self.table.columns
        cameras = [key for key in keys if key not in columns]
        if cameras:
            starts, _ = self.table.episode_bounds(frame_index)
            steps = (frame_index[:, None] + deltas).clamp(min=starts[:, None])  # (B, n_obs_steps)
            images = self.images(steps.flatten(), cameras)
            histories |= {key: images[key].unflatten(0, steps.shape) for key in cameras}
        vectors = (key for key in keys if key in columns)
        return histories | {key: self.table.gather(key, frame_index, deltas)[0] for key in vectors}

    def _locate(self, index: int) -> tuple[StoredEpisode, int]:
        frame = torch.tensor([index])
        number, (start, _) = int(self.table.episode(frame)), self.table.episode_bounds(frame)
        return self._collected[number - self._n_demonstrations], index - int(start)


def _tasks(dataset: LeRobotDataset) -> list[str]:
    """The task of every frame."""
    tasks = dataset.meta.tasks
    assert tasks is not None  # metadata of a dataset with frames
    names = {int(index): str(name) for name, index in tasks["task_index"].items()}
    return [names[int(index)] for index in dataset.hf_dataset.with_format("numpy")["task_index"][:]]
