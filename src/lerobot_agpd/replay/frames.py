"""Low-dimensional columns of a dataset held as tensors, and the gather that cuts chunks out of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor


@dataclass(frozen=True)
class FrameTable:
    """Frames of whole episodes, one row per frame, episodes back to back.

    Attributes:
        columns: feature name to a float tensor of shape (N, D).
        episode_start: (N,) row of the first frame of the episode that each frame belongs to.
        episode_end: (N,) row after the last frame of that episode.
    """

    columns: Mapping[str, Tensor]
    episode_start: Tensor
    episode_end: Tensor

    def __len__(self) -> int:
        """Number of frames N."""
        return len(self.episode_start)

    @classmethod
    def from_episode_lengths(cls, columns: Mapping[str, Tensor], lengths: Sequence[int]) -> FrameTable:
        """Build a table from columns whose episodes have these lengths (in frames).

        Raises:
            ValueError: if a column does not have exactly sum(lengths) rows.
        """
        counts = torch.as_tensor(lengths, dtype=torch.long)
        ends = counts.cumsum(0)
        for key, column in columns.items():
            if len(column) != int(counts.sum()):
                raise ValueError(f"column '{key}' has {len(column)} frames, the episodes {int(counts.sum())}")
        return cls(
            columns=columns,
            episode_start=(ends - counts).repeat_interleave(counts),
            episode_end=ends.repeat_interleave(counts),
        )

    @classmethod
    def from_dataset(cls, dataset: LeRobotDataset, keys: Sequence[str]) -> FrameTable:
        """Load the columns `keys` of every episode of a dataset into memory.

        Rows are LeRobot's absolute frame indices (the `index` column), whatever episodes a loader selects.

        Raises:
            KeyError: if the dataset lacks one of the features.
            ValueError: if its frames are not stored in the order of their index.
        """
        missing = [key for key in keys if key not in dataset.features]
        if missing:
            raise KeyError(
                f"dataset '{dataset.repo_id}' has no feature {missing}; it has {list(dataset.features)}"
            )
        frames = dataset.hf_dataset.select_columns(["index", *keys]).with_format("torch")[:]
        index = torch.as_tensor(frames["index"])
        if not torch.equal(index, torch.arange(len(index))):
            raise ValueError(
                f"frames of dataset '{dataset.repo_id}' are not stored in the order of their index"
            )
        columns = {key: torch.as_tensor(frames[key]).float().reshape(len(index), -1) for key in keys}
        episodes = dataset.meta.episodes
        starts, ends = (torch.as_tensor(episodes[f"dataset_{side}_index"]) for side in ("from", "to"))
        return cls.from_episode_lengths(columns, (ends - starts).tolist())

    def gather(self, key: str, index: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Values around frames, as LeRobot's `delta_timestamps` would deliver them.

        Args:
            key: column to read.
            index: (B,) rows.
            offsets: (K,) steps relative to each row; may be negative.

        Returns:
            Values (B, K, D), where steps outside the episode repeat its first or last frame, and the mask
            (B, K) that is True on those.
        """
        index = index.to(self.episode_start.device)
        rows = index[:, None] + offsets.to(index.device)  # (B, K)
        start, end = self.episode_start[index, None], self.episode_end[index, None]
        is_pad = (rows < start) | (rows >= end)
        return self.columns[key][rows.clamp(min=start, max=end - 1)], is_pad

    def rows_before_end(self, n_steps: int) -> Tensor:
        """Rows (M,) that lie at least `n_steps` before the last frame of their episode, in order."""
        rows = torch.arange(len(self), device=self.episode_end.device)
        return rows[rows < self.episode_end - n_steps]

    def concatenated(self, other: FrameTable) -> FrameTable:
        """This table followed by another one with the same columns; rows of this table keep their numbers.

        Raises:
            ValueError: if the columns differ.
        """
        if set(self.columns) != set(other.columns):
            raise ValueError(f"columns differ: {sorted(self.columns)} against {sorted(other.columns)}")
        return FrameTable(
            columns={key: torch.cat([column, other.columns[key]]) for key, column in self.columns.items()},
            episode_start=torch.cat([self.episode_start, other.episode_start + len(self)]),
            episode_end=torch.cat([self.episode_end, other.episode_end + len(self)]),
        )

    def with_columns(self, columns: Mapping[str, Tensor]) -> FrameTable:
        """The same frames with columns added or replaced."""
        return FrameTable({**self.columns, **columns}, self.episode_start, self.episode_end)
