"""AGPD while it trains, in the order of the paper.

    T  = demonstrations                                    replay/
    repeat
        stage 1  A_hat = pi_phi(O)                         distill/guided.py           Eq. 19
                 A ~ guided teacher near A_hat             collect/strategies.py       Eq. 20
                 execute, keep what succeeds: T += tau     `collect_round`
        stage 2  L = L_IL + s * L_AIL on T                 `extra_losses`              Eq. 21-22
                 representation: predict O_{t+n}           `extra_losses`              A.4

LeRobot's training loop drives it: `training_rows` and `extra_losses` from the student's forward, `after_update`
after every optimizer step.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from lerobot.utils.random_utils import seeded_context
from torch import Tensor

from lerobot_agpd.collect.decider import Decider
from lerobot_agpd.collect.report import success_rate
from lerobot_agpd.collect.seeds import noise_seed
from lerobot_agpd.collect.strategies import round_strength
from lerobot_agpd.distill.adversary import adversary_terms
from lerobot_agpd.distill.guided import Proposer
from lerobot_agpd.distill.parts import (
    check_steps,
    make_own_teacher,
    make_rounds,
    make_teacher,
    make_teacher_chunks,
)
from lerobot_agpd.distill.round_log import log_round, round_scalars
from lerobot_agpd.distill.schedule import due_round
from lerobot_agpd.distill.state import DistillationState
from lerobot_agpd.guidance.controller import next_scale
from lerobot_agpd.guidance.representation import reconstruction_loss
from lerobot_agpd.replay.memory import Batch, FrameMemory
from lerobot_agpd.replay.normalisation import Statistics
from lerobot_agpd.replay.replay import ROW, Replay
from lerobot_agpd.run import barrier, process_rank, this_run

if TYPE_CHECKING:
    from lerobot_agpd.distill.student import DistilledStudent

logger = logging.getLogger(__name__)

ADVERSARY_LOG = ("discriminator_loss", "adversarial_loss", "discriminator_accuracy")

PROPOSALS = 2
"""Stream of the noise that students draw from torch's own generator; the teacher's noise is stream 1."""


class Distillation:
    """Everything AGPD needs beside the student during training; none of it enters a checkpoint's weights.

    Args:
        student: the policy in training.
        dataset_meta: metadata of the demonstrations.
        dataset_stats: their statistics.
        seed: of environments, sampling noise and the choice of collected frames.

    Raises:
        ValueError: if a teacher or an environment is needed and missing, or does not fit.
    """

    def __init__(
        self,
        student: DistilledStudent,
        dataset_meta: LeRobotDatasetMetadata,
        dataset_stats: Statistics | None,
        seed: int,
    ):
        self.student = student
        self.config = student.config
        self.run = this_run()
        self.seed = seed
        self.rank = process_rank()
        self.state = DistillationState.restore(self.config, self.run)
        memory = FrameMemory(self.config, dataset_meta, dataset_stats)
        self.demonstrations = memory.dataset.meta
        share, image_transforms = self.config.replay.collected_share, self.run.image_transforms
        self.replay = Replay(memory, self.config, share, image_transforms)
        self.replay.seen_episodes.update(self.state.seen_episodes)
        self.own_teacher = make_own_teacher(student, self.state)
        self.teacher = None if self.own_teacher else make_teacher(student, self.demonstrations)
        self.rounds = make_rounds(self.config, self.run, self.state, self.demonstrations, self.teacher, seed)
        if self.rounds is not None:
            check_steps(student, self.teacher, memory.table)
        self.teacher_chunks = make_teacher_chunks(self.config, self.teacher, self.replay, seed)
        self.reports: list[Mapping[str, Any]] = []
        self._adopt_finished_rounds()

    def _adopt_finished_rounds(self) -> None:
        """Load the rounds on disk: those of the checkpoint, and those finished after it was written."""
        if self.rounds is None:
            return
        finished = self.rounds.store.rounds()
        if finished and self.state.checkpoint is None:
            self.rounds.check_own(finished[0].report)
        if len(finished) < self.state.rounds:
            raise FileNotFoundError(
                f"the checkpoint has used {self.state.rounds} collection rounds, {self.rounds.store.root} holds "
                f"{len(finished)}; point --policy.replay.root at the run's folder of collected episodes"
            )
        for round_ in finished:
            for dataset in round_.datasets:
                self.replay.add_dataset(dataset)
            self.reports.append(round_.report)
        self.state.rounds = len(finished)
        if finished:
            logger.info("replay holds %d finished rounds from %s", len(finished), self.rounds.store.root)

    # ---- the replay T ----

    def training_rows(self, batch: Batch) -> Batch:
        """A batch of T: the loader's frames, a share exchanged for collected ones."""
        self.replay.observe(batch)
        generator = torch.Generator().manual_seed(
            hash((self.seed, self.rank, self.state.updates))
            % 2**63  # stateless: resuming draws the same rows
        )
        rows = self.replay.training_rows(batch, generator)
        return self._relabelled(rows) if self.config.replay.relabel != "none" else rows

    def held_out_rows(self, batch: Batch) -> Batch:
        """A batch of demonstrations alone."""
        self.replay.memory.observe(batch)
        return self.replay.demonstration_rows(batch)

    def _relabelled(self, rows: Batch) -> Batch:
        """Rows whose recorded chunks are exchanged for the teacher's own, as `replay.relabel` says."""
        assert self.teacher_chunks is not None
        chunks, shared = self.teacher_chunks.at(rows[ROW], self.replay.seen_episodes)
        chosen = torch.ones_like(rows[ROW], dtype=torch.bool)
        if self.config.replay.relabel == "demonstrations":
            chosen = rows[ROW] < self.replay.n_demonstration_frames
        present = self.config.present_step
        action, is_pad = rows[ACTION].clone(), rows["action_is_pad"].clone()
        action[chosen, present : present + shared] = chunks[chosen, :shared]
        is_pad[chosen, present : present + shared] = False
        is_pad[chosen, present + shared :] = True  # the teacher says nothing of these steps
        return {**rows, ACTION: action, "action_is_pad": is_pad}

    # ---- stage 1: guided collection ----

    @property
    def scale(self) -> float:
        """Guidance scale of the next round."""
        return float(self.reports[-1]["next_scale"]) if self.reports else self.config.guidance.scale

    def collect_round(self) -> Mapping[str, Any]:
        """One round: every process rolls out its share, successes become part of T."""
        assert self.rounds is not None
        number, was_training = len(self.reports), self.student.training
        self.student.eval()
        with seeded_context(noise_seed(self.seed, self.rank, number, stream=PROPOSALS)):
            decider = self._make_decider(number)
            scale = round_strength(self.config.collect, number, self.scale) if self._has_target else 0.0
            records, seconds = self.rounds.collect(number, scale, decider)
        if self.rank == 0:
            diagnostics = self.rounds.diagnose(number, scale, decider)
            self.rounds.finish(number, self._report(number, scale, records, seconds, diagnostics))
        self.student.train(was_training)
        barrier()
        round_ = self.rounds.store.rounds()[number]
        for dataset in round_.datasets:
            self.replay.add_dataset(dataset)
        self.reports.append(round_.report)
        self.state.rounds = len(self.reports)
        if self.rank == 0:
            log_round(round_.report)
        return round_.report

    @property
    def _has_target(self) -> bool:
        """Whether there is somebody to guide toward; a student that teaches itself first needs a previous self."""
        return self.own_teacher is None or self.own_teacher.previous is not None

    def _make_decider(self, number: int) -> Decider:
        assert self.rounds is not None
        normaliser, acting = self.replay.memory.normaliser, None
        if self.own_teacher is not None:
            self.teacher = self.own_teacher.refresh(normaliser.stats)
            acting = self.own_teacher.previous
        assert self.teacher is not None
        return Proposer(self.student, normaliser, acting).decider(self.teacher, self.rounds.noise(number))

    def _report(
        self,
        number: int,
        scale: float,
        records: Any,
        seconds: Mapping[str, float],
        diagnostics: Mapping[str, Any] | None,
    ) -> dict[str, Any]:
        assert self.rounds is not None
        report = self.rounds.report(number, scale, records, seconds, diagnostics)
        report["updates"] = self.state.updates
        report["next_scale"] = self.scale
        if self.config.collect.guides:
            # A frozen teacher's rate is best known from all rounds; one that still learns has only its newest.
            known = (report,) if self.own_teacher else (*self.reports, report)
            report["next_scale"] = next_scale(
                self.scale,
                success_rate([report["guided"]]),
                success_rate([past["unguided"] for past in known]),
                self.config.guidance,
            )
        return report

    # ---- stage 2: training ----

    def extra_losses(self, rows: Batch) -> tuple[Tensor, dict[str, float]]:
        """What AGPD adds to L_IL on rows of T: the adversarial game and the representation's loss."""
        total = torch.zeros((), device=rows[ACTION].device)
        log: dict[str, float] = {}
        for loss, entries in (self._adversarial_loss(rows), self._representation_loss(rows)):
            total = total + loss
            log |= entries
        return total, log | {"collected_share": self.replay.share()} | round_scalars(self.reports)

    def _adversarial_loss(self, rows: Batch) -> tuple[Tensor | float, dict[str, float]]:
        config, updates = self.config.adversary, self.state.updates
        if config.weight == 0 or updates < config.start or updates % config.every:
            return 0.0, {}
        rows, reference_chunk, compared = self._reference_chunks(rows)
        if (
            len(reference_chunk) == 0
        ):  # LeRobot averages over processes by position: every one needs the same keys
            return 0.0, dict.fromkeys(ADVERSARY_LOG, 0.0)
        assert self.student.discriminator is not None
        student_chunk, embedding = self.student.prior_chunk(rows)
        terms = adversary_terms(
            self.student.discriminator,
            student_chunk * compared[..., None],
            reference_chunk * compared[..., None],
            embedding,
            config,
        )
        measured = (terms.discriminator.item(), terms.log_d.item(), terms.accuracy.item())
        return terms.discriminator + terms.student, dict(zip(ADVERSARY_LOG, measured, strict=True))

    def _reference_chunks(self, rows: Batch) -> tuple[Batch, Tensor, Tensor]:
        """What D compares the student with: the teacher's own chunks, or what a self-taught student executed.

        Returns:
            The rows concerned, chunks (B, S, A) in the student's normalised space, and the mask (B, S) that is
            True on the compared steps.
        """
        if self.teacher_chunks is not None:
            chunks, shared = self.teacher_chunks.at(rows[ROW], self.replay.seen_episodes)
            compared = torch.arange(chunks.shape[1], device=chunks.device) < shared
            return rows, chunks, compared.expand(len(chunks), -1)
        kept = rows[ROW] >= self.replay.n_demonstration_frames
        rows = {key: value[kept] for key, value in rows.items()}
        present = self.config.present_step
        return rows, rows[ACTION][:, present:], ~rows["action_is_pad"][:, present:]

    def _representation_loss(self, rows: Batch) -> tuple[Tensor | float, dict[str, float]]:
        representation = self.student.representation
        if representation is None:
            return 0.0, {}
        now, executed, later, is_pad = self.replay.executed_future(
            rows[ROW], self.replay.vector_keys, representation.n_steps
        )
        loss = reconstruction_loss(representation(now, executed), later, is_pad)
        return self.config.representation.weight * loss, {"representation_loss": loss.item()}

    # ---- alternation ----

    def after_update(self) -> None:
        """Count an optimizer step, and collect if a round is due; runs on every process."""
        self.state.updates += 1
        self.state.seen_episodes = sorted(self.replay.seen_episodes)
        if self.rounds is None:
            return
        due = due_round(self.state.updates, self.config.collect, self.run.steps)
        if due is not None and due >= len(self.reports):
            self.collect_round()
        if self.state.updates == self.run.steps and self.rank == 0:
            self.rounds.merge()

    def save(self, folder: Path) -> None:
        """Write what a resumed run must know beside a checkpoint's weights."""
        self.state.save(folder)
        if self.own_teacher is not None:
            self.own_teacher.save(folder)
