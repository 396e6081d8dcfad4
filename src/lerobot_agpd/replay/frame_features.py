"""Features of T's camera frames: computed once per frame where the encoder is frozen, kept in half precision on disk."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from itertools import batched

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.guidance.visual import VisualEncoder
from lerobot_agpd.replay.demonstrations import DemonstrationFrames
from lerobot_agpd.replay.episode import Array
from lerobot_agpd.replay.images import RecordedFrames, as_floats

BLOCK = 4096
"""Frames per file. Files are unnamed, lie in the folder TMPDIR and take no room for frames without features."""

BATCH_SIZE = 64
"""Frames that are encoded at once."""


class FrameFeatures:
    """Features of the frames of T.

    Args:
        frames: the camera frames of T.
        cameras: names of the cameras.
        encoder: makes the features.
        demonstrations: know the student's normalization, and the device.
    """

    def __init__(
        self,
        frames: RecordedFrames,
        cameras: Sequence[str],
        encoder: VisualEncoder,
        demonstrations: DemonstrationFrames,
    ):
        self.frames, self.cameras, self.encoder = frames, list(cameras), encoder
        self.demonstrations = demonstrations
        self._blocks: list[Array] = []  # (BLOCK, N * F) float16
        self._known: set[int] = set()

    def at(self, frame_index: Tensor) -> Tensor:
        """Features (B, N * F) of frames (B,)."""
        index = frame_index.cpu()
        if not self.encoder.is_frozen:
            return self._encode(index)
        missing = [row for row in index.unique().tolist() if row not in self._known]
        for rows in batched(missing, BATCH_SIZE):
            part = torch.tensor(rows)
            for row, features in zip(rows, self._encode(part).half().cpu().numpy(), strict=True):
                self._row(row)[:] = features
        self._known.update(missing)
        return (
            torch.from_numpy(np.stack([self._row(row) for row in index.tolist()]))
            .float()
            .to(self.demonstrations.device)
        )

    def _encode(self, index: Tensor) -> Tensor:
        images = self.frames.images(index, self.cameras)
        device, normalizer = self.demonstrations.device, self.demonstrations.normalizer
        floats = {key: as_floats(values.to(device)) for key, values in images.items()}
        return self.encoder.encode(floats, normalizer.normalize)

    def _row(self, row: int) -> Array:
        """Where the features of a frame are kept."""
        while row >= len(self._blocks) * BLOCK:
            shape = (BLOCK, self.encoder.n_tokens * self.encoder.dim)
            with tempfile.TemporaryFile() as file:  # it lives as long as it is mapped
                file.truncate(2 * shape[0] * shape[1])
                self._blocks.append(np.memmap(file, dtype=np.float16, mode="r+", shape=shape))
        return self._blocks[row // BLOCK][row % BLOCK]
