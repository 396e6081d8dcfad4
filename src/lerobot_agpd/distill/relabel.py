"""The teacher's own chunks at recorded observations: what the discriminator compares the student with."""

from __future__ import annotations

import logging
import time

import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.replay.replay import Replay

logger = logging.getLogger(__name__)

BATCH_SIZE = 256


class TeacherChunks:
    """Unguided teacher chunks for the rows of T, sampled once per row and remembered.

    Args:
        teacher: the teacher.
        replay: T.
        n_chunk_steps: steps S of the student's chunk from the current one on.
        seed: of the sampling noise.
    """

    def __init__(self, teacher: Teacher, replay: Replay, n_chunk_steps: int, seed: int):
        self.teacher = teacher
        self.replay = replay
        self.n_shared = min(n_chunk_steps, teacher.n_chunk_steps)
        self.n_chunk_steps = n_chunk_steps
        self.seed = seed
        self.seconds = 0.0
        self._chunks: Tensor | None = None  # (N, S, A) student-normalised, NaN where not sampled yet

    def at(self, rows: Tensor, seen_episodes: set[int]) -> tuple[Tensor, int]:
        """Chunks (B, S, A) in the student's normalised space, zero beyond the shared steps, and their number.

        A row without a chunk has all rows of T sampled that lack one: the demonstrations' seen episodes and
        every collected frame.
        """
        chunks = self._allocated(rows.device)
        if torch.isnan(chunks[rows, 0, 0]).any():
            self._sample(self._missing(chunks, seen_episodes))
        return self._allocated(rows.device)[rows], self.n_shared

    def _allocated(self, device: torch.device) -> Tensor:
        n_rows = len(self.replay.table)
        known = 0 if self._chunks is None else len(self._chunks)
        if known < n_rows:
            action_dim = self.replay.table.columns[ACTION].shape[1]
            empty = torch.full((n_rows - known, self.n_chunk_steps, action_dim), float("nan"), device=device)
            self._chunks = empty if self._chunks is None else torch.cat([self._chunks, empty])
        assert self._chunks is not None
        return self._chunks

    def _missing(self, chunks: Tensor, seen_episodes: set[int]) -> Tensor:
        episodes = self.replay.memory.dataset.meta.episodes
        wanted = torch.zeros(len(chunks), dtype=torch.bool)
        for episode in seen_episodes:
            start, end = (int(episodes[f"dataset_{side}_index"][episode]) for side in ("from", "to"))
            wanted[start:end] = True
        wanted[self.replay.n_demonstration_frames :] = True
        return (wanted & torch.isnan(chunks[:, 0, 0]).cpu()).nonzero()[:, 0]

    def _sample(self, rows: Tensor) -> None:
        """Sample whole episodes, each with noise of its own: when an episode is sampled does not change its chunks."""
        assert self._chunks is not None
        began = time.perf_counter()
        keys = list(self.teacher.input_features)
        table = self.replay.raw
        for start in table.episode_start[rows].unique().tolist():
            episode = torch.arange(start, int(table.episode_end[start]))
            generator = torch.Generator(device=self._chunks.device).manual_seed(self.seed + start)
            for part in episode.split(BATCH_SIZE):
                history = self.replay.history(part, keys, self.teacher.n_obs_steps)
                with torch.autocast(
                    self._chunks.device.type, enabled=False
                ):  # as precise as what it executes
                    raw = self.teacher.sample(history, generator=generator)[:, : self.n_shared]
                normalised = self.replay.memory.normaliser.normalise(ACTION, raw.to(self._chunks.device))
                self._chunks[part] = 0.0
                self._chunks[part, : self.n_shared] = normalised
        self.seconds += time.perf_counter() - began
        logger.info(
            "teacher chunks at %d recorded frames took %.1f s", len(rows), time.perf_counter() - began
        )
