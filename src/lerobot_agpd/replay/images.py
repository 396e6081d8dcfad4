"""Camera frames and tasks of T."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_agpd.replay.camera_frames import MEMORY_LIMIT, CameraFrames
from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.stored import StoredEpisode


class RecordedFrames:
    """What the frames of T hold beside their columns.

    Args:
        dataset: the demonstrations, the first episodes of T.
        table: the columns of T, which grow.
        memory_limit: bytes of camera frames held in memory.
    """

    def __init__(self, dataset: LeRobotDataset, table: FrameTable, memory_limit: int = MEMORY_LIMIT):
        self.dataset = dataset
        self.table = table
        self.n_demonstration_frames = len(table)
        self._n_demonstrations = len(table.lengths)
        self._tasks = _tasks(dataset)
        self._episode_tasks: list[str] = []  # of collected episodes
        self.cameras = CameraFrames(table, self._decode, dataset.meta.depth_keys, memory_limit)

    def append(self, episode: StoredEpisode) -> None:
        """Add a collected episode, whose columns the table has."""
        self._episode_tasks.append(episode.task)
        self.cameras.append(episode)

    def images(
        self, frame_index: Tensor, keys: Sequence[str], n_obs_steps: int | None = None
    ) -> dict[str, Tensor]:
        """Cameras' frames (B, C, H, W) in uint8 (depth: float32); each distinct demonstration frame is decoded once.

        With `n_obs_steps` histories (B, n_obs_steps, C, H, W); an episode's first frame repeats.
        """
        if n_obs_steps is None:
            return self.cameras.read(frame_index, keys)
        index, deltas = frame_index.cpu(), torch.arange(1 - n_obs_steps, 1)
        starts, _ = self.table.episode_bounds(index)
        steps = (index[:, None] + deltas).clamp(min=starts[:, None])  # (B, n_obs_steps)
        images = self.cameras.read(steps.flatten(), keys)
        return {key: values.unflatten(0, steps.shape) for key, values in images.items()}

    def task(self, index: int) -> str:
        """The task of a frame's episode."""
        if index < self.n_demonstration_frames:
            return self._tasks[index]
        return self._episode_tasks[int(self.table.episode(torch.tensor([index]))) - self._n_demonstrations]

    def history(self, frame_index: Tensor, keys: Sequence[str], n_obs_steps: int) -> dict[str, Any]:
        """Raw observation histories (B, n_obs_steps, ...) of frames, and their `task`s; an episode's first frame repeats.

        Images are floats in [0, 1], as a teacher takes them.
        """
        columns = self.table.columns
        deltas = torch.arange(1 - n_obs_steps, 1)
        histories: dict[str, Any] = {"task": [self.task(index) for index in frame_index.tolist()]}
        cameras = [key for key in keys if key not in columns]
        if cameras:
            images = self.images(frame_index, cameras, n_obs_steps)
            histories |= {key: as_floats(values) for key, values in images.items()}
        vectors = (key for key in keys if key in columns)
        return histories | {key: self.table.gather(key, frame_index, deltas)[0] for key in vectors}

    def _decode(self, index: int) -> dict[str, Tensor]:
        """All cameras of a demonstration frame, (C, H, W) in [0, 1]."""
        item: Any = self.dataset[index]
        return {key: item[key] for key in self.dataset.meta.camera_keys}


def as_floats(images: Tensor) -> Tensor:
    """Images of uint8 as floats in [0, 1]; floats stay as they are."""
    return images.float() / 255 if images.dtype == torch.uint8 else images


def _tasks(dataset: LeRobotDataset) -> list[str]:
    """The task of every frame."""
    tasks = dataset.meta.tasks
    assert tasks is not None  # metadata of a dataset with frames
    names = {int(index): str(name) for name, index in tasks["task_index"].items()}
    return [names[int(index)] for index in dataset.hf_dataset.with_format("numpy")["task_index"][:]]
