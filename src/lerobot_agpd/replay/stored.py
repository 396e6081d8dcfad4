"""A kept episode on disk, memory-mapped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from lerobot.utils.constants import OBS_PREFIX

from lerobot_agpd.replay.episode import Array, EpisodeRecord

MAX_OPEN_FILES = 256
"""Memory maps held open; each takes a file descriptor, of which a process has 1024 by default."""


@dataclass(frozen=True)
class StoredEpisode:
    """A kept episode of T steps, read from disk where it is used.

    Attributes:
        record: its record.
        task: the environment's description of its task.
        path: file of its vectors; those of its cameras lie beside it.
        cameras: names of the features with a file of their own.
    """

    record: EpisodeRecord
    task: str
    path: Path
    cameras: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Number of steps T."""
        return self.record.length

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of all columns."""
        return (*(self._open(self.path).dtype.names or ()), *self.cameras)

    @property
    def observations(self) -> dict[str, Array]:
        """All observation features, memory-mapped."""
        return {key: self.column(key) for key in self.keys if key.startswith(OBS_PREFIX)}

    def column(self, key: str) -> Array:
        """A feature's values (T, ...), memory-mapped.

        Raises:
            KeyError: if the episode has no such feature.
            ValueError: if its file is damaged.
        """
        if key in self.cameras:
            return self._open(camera_path(self.path, key))
        vectors = self._open(self.path)
        if key not in (vectors.dtype.names or ()):
            raise KeyError(f"{self.path} has no feature '{key}'; it has {list(self.keys)}")
        return vectors[key]

    def frame(self, key: str, step: int) -> Array:
        """A copy of a feature's value at one step."""
        return np.array(self.column(key)[step])

    def _open(self, path: Path) -> Array:
        try:
            rows = _memory_mapped(path)
            if len(rows) != len(self):
                raise ValueError(f"{len(rows)} steps instead of {len(self)}")
        except (OSError, ValueError, EOFError, TypeError) as error:
            raise ValueError(
                f"{path} is missing or damaged ({error}); restore it, or go on without the episode: delete the "
                f'line with "number": {self.record.number} from the index {_index_of(self.path)}'
            ) from error
        return rows


def split_columns(columns: Mapping[str, Array]) -> tuple[dict[str, Array], dict[str, Array]]:
    """Vectors (T,) or (T, D), and camera frames (T, H, W, C)."""
    images = {key: values for key, values in columns.items() if values.ndim > 2}
    return {key: values for key, values in columns.items() if key not in images}, images


def camera_path(path: Path, key: str) -> Path:
    """File of a camera beside the file of an episode's vectors."""
    return path.with_name(f"{path.stem}.{key}.npy")


def _index_of(path: Path) -> Path:
    return path.with_name(f"{path.stem.rsplit('-', 1)[0]}.jsonl")


@lru_cache(maxsize=MAX_OPEN_FILES)
def _memory_mapped(path: Path) -> Array:
    return np.load(path, mmap_mode="r", allow_pickle=False)
