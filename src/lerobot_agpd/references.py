"""What the discriminator compares the student with at a training step (Eq. 21)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from accelerate import PartialState
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.adversary import AdversaryBatch
from lerobot_agpd.config import StudentConfig
from lerobot_agpd.flag_checks import require
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.progress import Progress
from lerobot_agpd.replay.chunk_store import ChunkStore
from lerobot_agpd.replay.demonstrations import Batch
from lerobot_agpd.replay.reference_pool import PER_DECISION, ReferencePool
from lerobot_agpd.replay.replay import FRAME_INDEX, Replay
from lerobot_agpd.replay.teacher_chunks import TeacherChunks, TeacherSampler
from lerobot_agpd.student import executed_steps


@dataclass(frozen=True)
class References:
    """Where the expert's chunks come from; without a pool and a teacher's chunks, from T itself.

    Attributes:
        config: the student's.
        replay: T.
        pool: the teacher's chunks at a sample of T's frames, in runs that collect.
        teacher_chunks: its chunks at every frame of T.
    """

    config: StudentConfig
    replay: Replay
    pool: ReferencePool | None = None
    teacher_chunks: TeacherChunks | None = None

    def batch(self, batch: Batch, n_rounds: int, generator: torch.Generator) -> AdversaryBatch:
        """The expert's chunks, and the observations there.

        Args:
            batch: of T, the training step's.
            n_rounds: rounds in T.
            generator: chooses frames of the pool.
        """
        if self.pool is not None:
            drawn = self.pool.draw(n_rounds, len(batch[FRAME_INDEX]), generator)
            return _shared(self.replay.batch_at(drawn.frame_index), drawn.chunk, drawn.n_shared)
        if self.teacher_chunks is not None:
            return _shared(batch, *self.teacher_chunks.at(batch[FRAME_INDEX]))
        # Self-distillation: against its own chunks D would separate a policy from itself; so the executed ones.
        kept = batch[FRAME_INDEX] >= self.replay.n_demonstration_frames
        batch = {key: value[kept] for key, value in batch.items()}
        present = self.config.present_step
        return AdversaryBatch(batch, batch[ACTION][:, present:], ~batch["action_is_pad"][:, present:])

    def take_sample_count(self) -> int:
        """Chunks of the teacher that were sampled since the last call."""
        source = self.pool or self.teacher_chunks
        return source.sampler.take_count() if source is not None else 0


def make_references(
    config: StudentConfig,
    teacher: Teacher | None,
    replay: Replay,
    progress: Progress,
    seed: int,
    store: ChunkStore | None,
) -> tuple[TeacherChunks | None, References]:
    """Build what samples the teacher at recorded frames, for relabeling (None if there is none) and for the adversary.

    In a run that collects, the adversary has a sample of T's frames, which grows with every round: the teacher's time
    belongs to collection. Without rounds, or where every frame is relabeled, it has the chunks of all frames.

    Raises:
        FlagError: if relabeling would leave recorded steps behind the teacher's.
    """
    if teacher is None or not config.needs_teacher_chunks:
        return None, References(config, replay)
    masks_padding = getattr(config, "do_mask_loss_for_padding", True)  # without that setting: always, as ACT
    require(
        config.replay.relabel == "none" or masks_padding or teacher.n_chunk_steps >= config.future_steps,
        f"--policy.replay.relabel={config.replay.relabel}: the teacher predicts {teacher.n_chunk_steps} steps from the "
        f"current one on, the student's chunk has {config.future_steps}, and its loss counts the recorded steps behind "
        "the teacher's; pass --policy.do_mask_loss_for_padding=true, which leaves them out",
    )
    sampler = TeacherSampler(teacher, replay, config.future_steps)
    chunks = TeacherChunks(sampler, replay, seed, store)
    if not config.collect.enabled or config.replay.relabel == "all":
        return chunks, References(config, replay, teacher_chunks=chunks)
    processes = PartialState()
    decisions = float(replay.table.lengths.float().mean()) / executed_steps(config, teacher)
    per_round = math.ceil(PER_DECISION * config.collect.episodes * decisions)
    rank, n_ranks = processes.process_index, processes.num_processes
    pool = ReferencePool(sampler, replay, per_round, seed, progress.reference_frames, rank, n_ranks)
    return chunks if config.replay.relabel != "none" else None, References(config, replay, pool)


def _shared(batch: Batch, chunk: Tensor, n_shared: int) -> AdversaryBatch:
    """Chunks (B, S, A) of which the first `n_shared` steps are compared."""
    compared = torch.arange(chunk.shape[1], device=chunk.device) < n_shared
    return AdversaryBatch(batch, chunk, compared.expand(len(chunk), -1))
