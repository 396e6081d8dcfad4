"""Single frames for LeRobot's loader, a batch at a time from memory.

LeRobotDataset reads and converts every column of every frame by itself, which takes longer than a small network's training
step. torch's loader calls `dataset.__getitems__` with the indices of a batch where a dataset has that method, and LeRobot's
has none: `serve_from_memory` gives it one. Order, shards, workers and collation stay the loader's, and the items are equal.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

Item = dict[str, Any]


class ServedFrames:
    """All frames of a dataset without cameras, as LeRobotDataset delivers them one by one.

    Args:
        dataset: the dataset; the episodes that it selects are held.
        first: its first item, for names, types and shapes.
    """

    def __init__(self, dataset: LeRobotDataset, first: Item):
        frames = dataset.hf_dataset.with_format("numpy")[:]
        self.columns = {
            key: torch.as_tensor(frames[key]).to(value.dtype).reshape(-1, *value.shape)
            for key, value in first.items()
            if isinstance(value, Tensor)
        }
        self.texts = {
            key: list(frames[key]) for key, value in first.items() if key in frames and isinstance(value, str)
        }
        tasks = dataset.meta.tasks
        assert tasks is not None  # metadata of a dataset with frames
        self.tasks = [str(name) for name in tasks.index]

    def __call__(self, indices: Sequence[int]) -> list[Item]:
        """The items at relative indices, in the order of LeRobot's own keys."""
        rows = torch.as_tensor(indices)
        columns: dict[str, Sequence[Any]] = {
            key: column[rows].unbind() for key, column in self.columns.items()
        }
        columns |= {key: [str(texts[index]) for index in indices] for key, texts in self.texts.items()}
        columns["task"] = [self.tasks[index] for index in self.columns["task_index"][rows].tolist()]
        return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def serve_from_memory(dataset: LeRobotDataset) -> None:
    """Let a loader read a dataset's batches from memory.

    One with cameras, or that delivers chunks, stays as it is: its items cannot be held, or are not single frames.
    """
    if dataset.meta.camera_keys or dataset.delta_timestamps or hasattr(dataset, "__getitems__"):
        return
    first = dataset[0]
    assert isinstance(first, dict)  # a slice delivers a list
    if all(isinstance(value, Tensor | str) for value in first.values()):  # no annotations in natural language
        dataset.__getitems__ = ServedFrames(dataset, first)  # type: ignore[attr-defined]
