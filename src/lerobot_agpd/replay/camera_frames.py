"""Camera frames of T with random access: decoded once, in memory up to a limit, memory-mapped beyond it."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.replay.episode import Array
from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.stored import StoredEpisode

logger = logging.getLogger(__name__)

MEMORY_LIMIT = 2 * 2**30
"""Bytes of camera frames that one process holds in memory: 250 episodes of 50 steps with one camera take 0.35 GB at
96 x 96 pixels. Demonstrations beyond it are decoded into an unnamed temporary file (of the folder TMPDIR), collected
frames are read from the journal's files, and the system keeps of both what fits into memory that nobody else needs."""


class CameraFrames:
    """Frames (H, W, C) of the cameras of T, episode after episode.

    Args:
        table: T's columns, which know the episodes.
        decode: reads all cameras of one demonstration frame, (C, H, W) in [0, 1].
        depth_keys: cameras whose values are no uint8.
        memory_limit: bytes held in memory.
    """

    def __init__(
        self,
        table: FrameTable,
        decode: Callable[[int], Mapping[str, Tensor]],
        depth_keys: Sequence[str] = (),
        memory_limit: int = MEMORY_LIMIT,
    ):
        self.table = table
        self.n_demonstration_frames = len(table)
        self._decode, self._depth_keys = decode, set(depth_keys)
        self._free = memory_limit
        self._n_demonstrations = len(table.lengths)
        self._demonstrated: dict[str, Array] = {}  # (N, H, W, C), rows are undefined until they are decoded
        self._decoded = np.zeros(len(table), dtype=bool)
        self._collected: list[StoredEpisode] = []
        self._held: dict[tuple[int, str], Array] = {}  # frames of collected episodes that are in memory
        self._memory_limit = memory_limit

    @property
    def nbytes(self) -> int:
        """Bytes in memory, those of demonstrations that are yet to be decoded included."""
        return self._memory_limit - self._free

    def append(self, episode: StoredEpisode) -> None:
        """Add a collected episode, whose columns the table has."""
        number = len(self._collected)
        self._collected.append(episode)
        for key in episode.cameras:
            frames = episode.column(key)
            if self._take(frames.nbytes):
                self._held[number, key] = np.array(frames)

    def read(self, frame_index: Tensor, keys: Sequence[str]) -> dict[str, Tensor]:
        """Cameras' frames (B, C, H, W) in uint8; depth in float32, as the dataset delivers it."""
        index = frame_index.cpu()
        demonstrated = (index < self.n_demonstration_frames).numpy()
        if demonstrated.any():
            self._decode_missing(np.unique(index.numpy()[demonstrated]))
        episode = self.table.episode(index)
        step = (index - self.table.episode_bounds(index)[0]).numpy()
        images = {}
        for key in keys:
            frames: list[Array | None] = [None] * len(index)
            for row in np.flatnonzero(demonstrated):
                frames[row] = self._demonstrated[key][index[row]]
            for row in np.flatnonzero(~demonstrated):
                frame = self._collected_frames(int(episode[row]), key)[step[row]]
                frames[row] = frame.astype(np.float32) / 255 if key in self._depth_keys else frame
            # One copy of every frame; the permuted view is what convolutions call channels last.
            images[key] = torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2)  # type: ignore[arg-type]  # all are found
        return images

    def _collected_frames(self, episode: int, key: str) -> Array:
        """A camera's frames (T, H, W, C) in uint8 of an episode of T."""
        number = episode - self._n_demonstrations
        frames = self._held.get((number, key))
        return self._collected[number].column(key) if frames is None else frames

    def _decode_missing(self, index: Array) -> None:
        for row in index[~self._decoded[index]]:
            for key, image in self._decode(int(row)).items():
                frame = image.permute(1, 2, 0)  # (H, W, C)
                if key not in self._depth_keys:
                    frame = (frame * 255).round().to(torch.uint8)
                if key not in self._demonstrated:
                    self._demonstrated[key] = self._room(key, frame)
                self._demonstrated[key][row] = frame.numpy()
            self._decoded[row] = True

    def _room(self, key: str, frame: Tensor) -> Array:
        """Room for a camera's frames of all demonstrations; pages that are never written take none."""
        shape = (self.n_demonstration_frames, *frame.shape)
        dtype = np.dtype(np.float32 if key in self._depth_keys else np.uint8)
        size = int(np.prod(shape)) * dtype.itemsize
        if self._take(size):
            return np.empty(shape, dtype=dtype)
        logger.info(
            "'%s' of the demonstrations, %.1f GB, is memory-mapped in %s",
            key,
            size / 1e9,
            tempfile.gettempdir(),
        )
        with tempfile.TemporaryFile() as file:  # it lives as long as it is mapped
            file.truncate(size)
            return np.memmap(file, dtype=dtype, mode="r+", shape=shape)

    def _take(self, size: int) -> bool:
        """Reserve bytes in memory, if there are enough left."""
        if size > self._free:
            return False
        self._free -= size
        return True
