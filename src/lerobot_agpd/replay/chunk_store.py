"""The teacher's chunks on disk: a slow teacher is asked once, also by a run that is resumed."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.files import write_array, write_json

logger = logging.getLogger(__name__)

FOLDER = "teacher_chunks"


class ChunkStore:
    """One file per episode, in the environment's units, under a folder named after what the chunks depend on.

    Args:
        root: folder of all stores of a run.
        identity: what the chunks depend on: teacher, its sampler, seed, demonstrations. Another one begins a new folder.
        writes: whether this process writes; all read.
    """

    def __init__(self, root: Path, identity: Mapping[str, Any], writes: bool):
        key = hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()[:12]
        self.folder, self.identity, self.writes = root / key, dict(identity), writes

    def read(self, episode: int, shape: tuple[int, ...]) -> Tensor | None:
        """Chunks (T, S, A) of an episode; None if there are none, or the file is not of that shape."""
        path = self._path(episode)
        if not path.is_file():
            return None
        try:
            chunks = np.load(path)
        except (OSError, ValueError, EOFError) as error:
            logger.warning("%s is damaged (%s); the teacher is asked again", path, error)
            return None
        return torch.from_numpy(chunks) if chunks.shape == shape else None

    def write(self, episode: int, chunks: Tensor) -> None:
        """Keep the chunks (T, S, A) of an episode."""
        if not self.writes:
            return
        if not self.folder.is_dir():
            self.folder.mkdir(parents=True)
            write_json(self.folder / "identity.json", self.identity, indent=2)
        write_array(self._path(episode), chunks.cpu().numpy())

    def _path(self, episode: int) -> Path:
        return self.folder / f"{episode:06d}.npy"
