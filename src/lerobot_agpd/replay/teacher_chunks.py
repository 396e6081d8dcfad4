"""The teacher's own chunks at recorded observations: what the discriminator compares the student with."""

from __future__ import annotations

import logging
import sys
import time

import torch
from lerobot.utils.constants import ACTION
from torch import Tensor
from tqdm import tqdm

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.replay.chunk_store import ChunkStore
from lerobot_agpd.replay.demonstrations import Batch
from lerobot_agpd.replay.gate import FarValues
from lerobot_agpd.replay.growing import GrowingTensor
from lerobot_agpd.replay.replay import FRAME_INDEX, Replay

logger = logging.getLogger(__name__)

BATCH_SIZE = 256

BAR_AFTER = 5.0
"""Seconds after which sampling shows its progress."""


class TeacherChunks:
    """Unguided teacher chunks for the frames of T, sampled once per episode and kept in memory, and on disk if wanted.

    Args:
        teacher: the teacher.
        replay: T.
        n_chunk_steps: steps S of the student's chunk from the current one on.
        seed: of the sampling noise.
        store: where sampled chunks are kept on disk; None: nowhere.
    """

    def __init__(
        self,
        teacher: Teacher,
        replay: Replay,
        n_chunk_steps: int,
        seed: int,
        store: ChunkStore | None = None,
    ):
        self.teacher = teacher
        self.replay = replay
        self.store = store
        self.n_shared = min(n_chunk_steps, teacher.n_chunk_steps)
        self.n_chunk_steps = n_chunk_steps
        self.seed = seed
        self.seconds = 0.0
        self._chunks: GrowingTensor | None = None  # (N, S, A) in the student's normalized space
        self._sampled: set[int] = set()  # episodes
        self._far_values = FarValues()

    def at(self, frame_index: Tensor) -> tuple[Tensor, int]:
        """Chunks (B, S, A) in the student's normalized space, zero beyond the shared steps, and their number.

        If an episode of the frames has no chunks yet, all episodes of T that lack them are sampled: the
        demonstrations' seen episodes and every collected one.
        """
        chunks = self._grown(frame_index.device)
        episodes = set(self.replay.table.episode(frame_index.cpu()).tolist())
        if not episodes <= self._sampled:
            collected = range(self.replay.n_demonstrations, len(self.replay.table.lengths))
            self._sample(sorted({*episodes, *self.replay.seen_episodes, *collected} - self._sampled), chunks)
        return chunks[frame_index], self.n_shared

    def relabel(self, batch: Batch, config: StudentConfig) -> Batch:
        """A batch of T whose recorded chunks are exchanged for the teacher's own, where `replay.relabel` says so."""
        frame_index, present = batch[FRAME_INDEX], config.present_step
        chunks, n_shared = self.at(frame_index)
        chosen = torch.ones_like(frame_index, dtype=torch.bool)
        if config.replay.relabel == "demonstrations":
            chosen = frame_index < self.replay.n_demonstration_frames
        action, is_pad = batch[ACTION].clone(), batch["action_is_pad"].clone()
        action[chosen, present : present + n_shared] = chunks[chosen, :n_shared]
        is_pad[chosen, present : present + n_shared] = False
        is_pad[chosen, present + n_shared :] = True  # the teacher says nothing of these steps
        return {**batch, ACTION: action, "action_is_pad": is_pad}

    def _grown(self, device: torch.device) -> Tensor:
        """Room for the chunks of all frames of T."""
        if self._chunks is None:
            action_dim = self.replay.table.columns[ACTION].shape[1]
            self._chunks = GrowingTensor((self.n_chunk_steps, action_dim), torch.float32, device)
        self._chunks.grow(len(self.replay.table) - len(self._chunks))
        return self._chunks.values

    def _sample(self, episodes: list[int], chunks: Tensor) -> None:
        """Fill in whole episodes, each with noise of its own: when an episode is sampled does not change its chunks."""
        began, n_frames, n_stored = time.perf_counter(), 0, 0
        lengths = self.replay.table.lengths
        starts = (lengths.cumsum(0) - lengths).tolist()
        total = int(lengths[episodes].sum())
        # A terminal is told how far it is if that takes long; a log gets the line at the end.
        with tqdm(
            total=total,
            desc="teacher chunks",
            unit="frame",
            delay=BAR_AFTER,
            leave=False,
            disable=not sys.stderr.isatty(),
        ) as bar:
            for episode in episodes:
                frames = torch.arange(starts[episode], starts[episode] + int(lengths[episode]))
                raw, is_stored = self._raw_chunks(episode, frames, chunks)
                sampled = self.replay.demonstrations.normalizer.normalize(ACTION, raw.to(chunks.device))
                self._far_values.check("the teacher's chunks", ACTION, sampled)
                chunks[frames] = 0.0
                chunks[frames, : self.n_shared] = sampled
                n_frames += len(frames)
                n_stored += is_stored * len(frames)
                bar.update(len(frames))
        self._sampled.update(episodes)
        seconds = time.perf_counter() - began
        self.seconds += seconds
        logger.info(
            "teacher chunks at %d recorded frames took %.1f s (%d were on disk)", n_frames, seconds, n_stored
        )

    def _raw_chunks(self, episode: int, frames: Tensor, chunks: Tensor) -> tuple[Tensor, bool]:
        """The shared steps (T, n_shared, A) of an episode's chunks in the environment's units; whether disk had them."""
        stored = (
            self.store.read(episode, (len(frames), self.n_shared, chunks.shape[-1])) if self.store else None
        )
        if stored is not None:
            return stored, True
        generator = torch.Generator(device=chunks.device).manual_seed(self.seed + int(frames[0]))
        raw = torch.cat([self._teacher_chunks(part, generator) for part in frames.split(BATCH_SIZE)])
        if self.store is not None:
            self.store.write(episode, raw)
        return raw, False

    def _teacher_chunks(self, frame_index: Tensor, generator: torch.Generator) -> Tensor:
        """The shared steps (B, n_shared, A) of newly sampled chunks, in the environment's units."""
        history = self.replay.history(
            frame_index, list(self.teacher.input_features), self.teacher.n_obs_steps
        )
        with torch.autocast(generator.device.type, enabled=False):  # as precise as what it executes
            return self.teacher.sample(history, generator=generator)[:, : self.n_shared]
