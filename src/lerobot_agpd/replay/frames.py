"""Low-dimensional columns of whole episodes held as tensors, and the gather that cuts chunks out of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_agpd.replay.growing import GrowingTensor


class FrameTable:
    """Frames of whole episodes, episodes back to back; grows in place.

    Args:
        columns: feature name to values (N, D), stored as float32.
        lengths: number of frames of every episode.

    Raises:
        ValueError: if a column does not have exactly sum(lengths) rows.
    """

    def __init__(self, columns: Mapping[str, Tensor], lengths: Sequence[int]):
        self._columns = {
            key: GrowingTensor(column.shape[1:], torch.float32) for key, column in columns.items()
        }
        self._episode = GrowingTensor((), torch.int32)  # (N,) the episode of every frame
        self._bounds = GrowingTensor((), torch.long)  # (E + 1,) first frame of every episode, and N
        self._bounds.append(torch.zeros(1, dtype=torch.long))
        self.append(columns, lengths)

    @classmethod
    def from_dataset(cls, dataset: LeRobotDataset, keys: Sequence[str]) -> FrameTable:
        """Load the columns `keys` of every episode of a dataset into memory.

        Frames are numbered as in LeRobot's `index` column, whatever episodes a loader selects.

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
        assert episodes is not None  # metadata of a dataset with frames
        starts, ends = (torch.as_tensor(episodes[f"dataset_{side}_index"]) for side in ("from", "to"))
        return cls(columns, (ends - starts).tolist())

    def __len__(self) -> int:
        """Number of frames N."""
        return len(self._episode)

    @property
    def columns(self) -> dict[str, Tensor]:
        """Feature name to values (N, D); views that are valid until the next `append`."""
        return {key: column.values for key, column in self._columns.items()}

    @property
    def lengths(self) -> Tensor:
        """Number of frames (E,) of every episode."""
        return self._bounds.values.diff()

    @property
    def nbytes(self) -> int:
        """Bytes in memory, spare capacity included."""
        return sum(tensor.nbytes for tensor in (*self._columns.values(), self._episode, self._bounds))

    def append(self, columns: Mapping[str, Tensor], lengths: Sequence[int]) -> None:
        """Add episodes at the end; the frames that are there keep their numbers.

        Raises:
            ValueError: if the columns are not those of the table, or not of the lengths' sum.
        """
        counts = torch.as_tensor(lengths, dtype=torch.long)
        n_frames = int(counts.sum())
        self._check(columns, n_frames)
        for key, column in columns.items():
            self._columns[key].append(column)
        first = len(self._bounds) - 1
        episodes = torch.arange(first, first + len(counts), dtype=torch.int32)
        self._bounds.append(self._bounds.values[-1] + counts.cumsum(0))
        self._episode.append(episodes.repeat_interleave(counts))

    def _check(self, columns: Mapping[str, Tensor], n_frames: int) -> None:
        if set(self._columns) != set(columns):
            raise ValueError(f"columns differ: {sorted(self._columns)} against {sorted(columns)}")
        for key, column in columns.items():
            if len(column) != n_frames:
                raise ValueError(f"column '{key}' has {len(column)} frames, the episodes {n_frames}")
            own = self._columns[key].values.shape[1:]
            if column.shape[1:] != own:
                raise ValueError(
                    f"column '{key}' has shape {tuple(column.shape[1:])} per frame, expected {tuple(own)}"
                )

    def episode(self, index: Tensor) -> Tensor:
        """Episode number (B,) of frames (B,)."""
        return self._episode.values[index].long()

    def episode_bounds(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """First frame (B,) of the episodes of frames (B,), and the frame after their last one."""
        episode, bounds = self.episode(index), self._bounds.values
        return bounds[episode], bounds[episode + 1]

    def gather(self, key: str, index: Tensor, delta_indices: Tensor) -> tuple[Tensor, Tensor]:
        """Values around frames, as LeRobot's `delta_timestamps` would deliver them.

        Args:
            key: column to read.
            index: (B,) frames.
            delta_indices: (K,) steps relative to each frame; may be negative.

        Returns:
            Values (B, K, D), where steps outside the episode repeat its first or last frame, and the mask
            (B, K) that is True on those.
        """
        index = index.cpu()
        steps = index[:, None] + delta_indices  # (B, K)
        start, end = (bound[:, None] for bound in self.episode_bounds(index))
        is_pad = (steps < start) | (steps >= end)
        return self._columns[key].values[steps.clamp(min=start, max=end - 1)], is_pad


class ChunkStarts:
    """The frames that may begin a chunk: all but the last `n_dropped` of every episode, in order.

    Looking a frame up is a binary search over episodes, adding an episode costs O(1).
    """

    def __init__(self, n_dropped: int):
        self.n_dropped = n_dropped
        self._before = GrowingTensor((), torch.long)  # (E,) starts in all earlier episodes
        self._first = GrowingTensor((), torch.long)  # (E,) first frame of every episode
        self._total = 0

    def __len__(self) -> int:
        """Number of frames that may begin a chunk."""
        return self._total

    def append(self, first: int, length: int) -> None:
        """Add an episode of `length` frames that begins at frame `first`."""
        self._before.append(torch.tensor([self._total]))
        self._first.append(torch.tensor([first]))
        self._total += max(length - self.n_dropped, 0)

    def frames(self, positions: Tensor) -> Tensor:
        """Frame numbers (B,) of positions (B,) in the list of all starts."""
        # From the right: an episode without starts shares its count with the next one.
        episode = torch.searchsorted(self._before.values, positions, right=True) - 1
        return self._first.values[episode] + positions - self._before.values[episode]
