"""The teacher's own chunks at a sample of T's frames: what the discriminator compares the student with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from accelerate.utils import broadcast_object_list
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.replay.replay import Replay
from lerobot_agpd.replay.teacher_chunks import TeacherSampler

PER_DECISION = 0.25
"""Frames that enter the pool per decision of a round: a slow teacher's time belongs to collection."""


@dataclass(frozen=True)
class DrawnReferences:
    """Frames (B,) of T, and the teacher's chunks (B, S, A) there, zero beyond the `n_shared` steps that it predicts."""

    frame_index: Tensor
    chunk: Tensor
    n_shared: int


class ReferencePool:
    """Frames of T with the teacher's unguided chunks; grows with T.

    Every process knows all frames, and samples the teacher at its part of them.

    Args:
        sampler: samples the teacher at recorded frames.
        replay: T.
        per_round: frames that enter before the first round, and after each one.
        seed: of the choice of frames and of the sampling noise.
        batches: frames that entered before the first round and after each one, in a run that goes on; the list grows.
        rank: of this process.
        n_ranks: number of processes.
    """

    def __init__(
        self,
        sampler: TeacherSampler,
        replay: Replay,
        per_round: int,
        seed: int,
        batches: list[list[int]],
        rank: int = 0,
        n_ranks: int = 1,
    ):
        self.sampler, self.replay = sampler, replay
        self.per_round, self.seed = per_round, seed
        self.batches = batches
        self.rank, self.n_ranks = rank, n_ranks
        self._frames = torch.empty(0, dtype=torch.long)
        self._chunks = torch.empty(0, sampler.n_chunk_steps, replay.table.columns[ACTION].shape[1])
        self._n_sampled = 0  # batches

    def __len__(self) -> int:
        """Number of frames with chunks in this process."""
        return len(self._frames)

    def draw(self, n_rounds: int, n_rows: int, generator: torch.Generator) -> DrawnReferences:
        """Draw at most `n_rows` distinct frames, after the pool has grown to what `n_rounds` rounds ask for."""
        self._grow(n_rounds)
        rows = torch.randperm(len(self), generator=generator)[:n_rows]
        return DrawnReferences(
            self._frames[rows], self._chunks[rows.to(self._chunks.device)], self.sampler.n_shared
        )

    def _grow(self, n_rounds: int) -> None:
        """Enter frames once per round, and sample the teacher at those that have no chunks yet."""
        if len(self.batches) <= n_rounds:
            self.batches += [[] for _ in range(n_rounds - len(self.batches))]  # the adversary did not act yet
            # Processes have not all seen the same demonstrations: the frames are those that the first one chooses.
            n_known = sum(map(len, self.batches))
            self.batches += broadcast_object_list([self._choose(self.per_round * (n_rounds + 1) - n_known)])
        device = self.replay.demonstrations.device
        for number, batch in list(enumerate(self.batches))[self._n_sampled :]:
            self._n_sampled += 1
            part = batch[self.rank :: self.n_ranks] or batch  # all, where there are fewer than processes
            if part:
                frames = torch.tensor(part)
                seed = hash((self.seed, self.rank, number)) % 2**63
                chunks = self.sampler.chunks(frames, torch.Generator(device=device).manual_seed(seed))
                self._frames = torch.cat([self._frames, frames])
                self._chunks = torch.cat([self._chunks.to(chunks), chunks])

    def _choose(self, n_frames: int) -> list[int]:
        """New frames, uniform over those of T that begin a chunk."""
        taken = torch.tensor([frame for batch in self.batches for frame in batch], dtype=torch.long)
        frames = self.replay.starts()
        left = frames[~torch.isin(frames, taken)].numpy()
        rng = np.random.default_rng([self.seed, len(self.batches)])
        return sorted(rng.choice(left, min(n_frames, len(left)), replace=False).tolist())
