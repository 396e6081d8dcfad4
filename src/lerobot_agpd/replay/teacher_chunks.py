"""The teacher's own chunks at recorded observations: for relabeling, and for a discriminator without rounds."""

from __future__ import annotations

import logging
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
"""Frames that the teacher is sampled at together."""

LONG = 30.0
"""Seconds after which sampling shows a progress bar."""


class TeacherSampler:
    """Samples a teacher, unguided, at frames of T.

    Args:
        teacher: the teacher.
        replay: T.
        n_chunk_steps: steps S of the student's chunk from the current one on.

    Attributes:
        seconds: spent so far.
    """

    def __init__(self, teacher: Teacher, replay: Replay, n_chunk_steps: int):
        self.teacher, self.replay = teacher, replay
        self.n_chunk_steps = n_chunk_steps
        self.n_shared = min(n_chunk_steps, teacher.n_chunk_steps)
        self.seconds, self._count = 0.0, 0
        self._far_values = FarValues()

    def chunks(self, frame_index: Tensor, generator: torch.Generator) -> Tensor:
        """New chunks (B, S, A) in the student's normalized space, zero beyond the `n_shared` steps that the teacher has."""
        return self.normalized(self.raw(frame_index, generator), generator.device)

    def raw(self, frame_index: Tensor, generator: torch.Generator) -> Tensor:
        """The shared steps (B, n_shared, A) of new chunks, in the environment's units."""
        began = time.perf_counter()
        parts = tqdm(
            frame_index.split(BATCH_SIZE), desc="Sampling the teacher", unit="batch", leave=False, delay=LONG
        )
        sampled = torch.cat([self._shared(part, generator) for part in parts])
        self._count += len(sampled)
        self.seconds += time.perf_counter() - began
        return sampled

    def normalized(self, raw: Tensor, device: torch.device) -> Tensor:
        """Chunks (B, S, A) of `raw` ones."""
        shared = self.replay.demonstrations.normalizer.normalize(ACTION, raw.to(device))
        self._far_values.check("the teacher's chunks", ACTION, shared)
        chunks = shared.new_zeros(len(shared), self.n_chunk_steps, shared.shape[2])
        chunks[:, : self.n_shared] = shared
        return chunks

    def take_count(self) -> int:
        """Number of chunks sampled since the last call."""
        count, self._count = self._count, 0
        return count

    def _shared(self, frame_index: Tensor, generator: torch.Generator) -> Tensor:
        history = self.replay.history(
            frame_index, list(self.teacher.input_features), self.teacher.n_obs_steps
        )
        with torch.autocast(generator.device.type, enabled=False):  # as precise as what it executes
            return self.teacher.sample(history, generator=generator)[:, : self.n_shared]


class TeacherChunks:
    """Unguided teacher chunks for the frames of T, sampled once per episode and kept in memory, and on disk.

    Args:
        sampler: samples the teacher at recorded frames.
        replay: T.
        seed: of the sampling noise.
        store: where sampled chunks are kept on disk; None: nowhere.
    """

    def __init__(self, sampler: TeacherSampler, replay: Replay, seed: int, store: ChunkStore | None = None):
        self.sampler, self.replay, self.seed, self.store = sampler, replay, seed, store
        self._chunks: GrowingTensor | None = None  # (N, S, A) in the student's normalized space
        self._sampled: set[int] = set()  # episodes

    def at(self, frame_index: Tensor) -> tuple[Tensor, int]:
        """Chunks (B, S, A) in the student's normalized space, zero beyond the shared steps, and their number.

        Episodes of the frames that have no chunks yet are sampled.
        """
        chunks = self._grown(frame_index.device)
        episodes = set(self.replay.table.episode(frame_index.cpu()).tolist()) - self._sampled
        if episodes:
            self._sample(sorted(episodes), chunks)
        return chunks[frame_index], self.sampler.n_shared

    def relabel(self, batch: Batch, config: StudentConfig) -> Batch:
        """A batch of T whose recorded chunks are exchanged for the teacher's own, where `replay.relabel` says so."""
        frame_index, present = batch[FRAME_INDEX], config.present_step
        chosen = torch.ones_like(frame_index, dtype=torch.bool)
        if config.replay.relabel == "demonstrations":
            chosen = frame_index < self.replay.n_demonstration_frames
        if not chosen.any():
            return batch
        chunks, n_shared = self.at(frame_index[chosen])
        action, is_pad = batch[ACTION].clone(), batch["action_is_pad"].clone()
        action[chosen, present : present + n_shared] = chunks[:, :n_shared]
        is_pad[chosen, present : present + n_shared] = False
        is_pad[chosen, present + n_shared :] = True  # the teacher says nothing of these steps
        return {**batch, ACTION: action, "action_is_pad": is_pad}

    def _grown(self, device: torch.device) -> Tensor:
        """Room for the chunks of all frames of T."""
        if self._chunks is None:
            action_dim = self.replay.table.columns[ACTION].shape[1]
            self._chunks = GrowingTensor((self.sampler.n_chunk_steps, action_dim), torch.float32, device)
        self._chunks.grow(len(self.replay.table) - len(self._chunks))
        return self._chunks.values

    def _sample(self, episodes: list[int], chunks: Tensor) -> None:
        """Fill in whole episodes, each with noise of its own: when an episode is sampled does not change its chunks."""
        before, n_stored = self.sampler.seconds, 0
        bounds = torch.cat([torch.zeros(1, dtype=torch.long), self.replay.table.lengths.cumsum(0)])
        for episode in tqdm(episodes, desc="Sampling the teacher", unit="episode", leave=False, delay=LONG):
            start, end = bounds[episode : episode + 2].tolist()
            shape = (end - start, self.sampler.n_shared, chunks.shape[2])
            raw = self.store.read(episode, shape) if self.store else None
            n_stored += raw is not None
            if raw is None:
                generator = torch.Generator(device=chunks.device).manual_seed(self.seed + start)
                raw = self.sampler.raw(torch.arange(start, end), generator)
                if self.store is not None:
                    self.store.write(episode, raw)
            chunks[start:end] = self.sampler.normalized(raw, chunks.device)
        self._sampled.update(episodes)
        seconds = self.sampler.seconds - before
        logger.info(
            "teacher chunks of %d episodes took %.1f s (%d were on disk)", len(episodes), seconds, n_stored
        )
