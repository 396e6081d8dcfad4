"""Adaptive Guidance Policy Distillation (AGPD), top to bottom in the order of the paper.

    T = demonstrations
    every `collect.every` training steps
        stage 1   A_hat = pi_phi(O)                             Eq. 19      GuidedStrategy.act
                  A ~ teacher, its denoising pulled to A_hat    Eq. 20      GuidedStrategy.act
                  execute A, keep what succeeds                             AGPD.collect_round
                  T += kept episodes                                        AGPD.grow
                  adapt the pull                                            next_strength
    every training step
        stage 2   minimize L_IL + s * L_AIL on T                Eq. 21-22   AGPD.losses
                  predict O_{t+n} from O_t and A                A.4         AGPD.losses

| paper                  | here                                                                                       |
| ---------------------- | ------------------------------------------------------------------------------------------ |
| pi_theta, distilled DM | teacher: frozen, in guidance/teacher.py                                                    |
| pi_phi                 | student: what is needed of it is in student.py                                             |
| A_hat                  | chunk_hat, (B, S, A), the student's chunk                                                  |
| J, F_measure           | discrepancy, (B,), between a chunk of the teacher and A_hat (guidance/discrepancy.py)      |
| k                      | guidance scale, from the `strength` of an episode: its pull (guidance/pull.py); 0: teacher  |
| D_w, s                 | discriminator, adversary.weight (adversary.py)                                             |
| E, D of A.4            | representation (guidance/representation.py)                                                |
| T                      | replay, in memory (replay/replay.py); journal, on disk (replay/journal.py)                 |

LeRobot's own training loop drives it, through policies/distilled.py; build.py puts the parts together.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch
from accelerate import PartialState
from accelerate.utils import broadcast_object_list
from lerobot.utils.constants import ACTION
from lerobot.utils.random_utils import seeded_context
from torch import Tensor

from lerobot_agpd.adversary import AdversaryBatch, Discriminator, adversary_terms
from lerobot_agpd.build import Parts
from lerobot_agpd.config import CollectConfig, GuidanceConfig, StudentConfig
from lerobot_agpd.continuation import announcement
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.guidance.representation import WEIGHT, reconstruction_loss
from lerobot_agpd.guidance.strength import (
    first_strength,
    guidance_scale,
    guidance_scales,
    largest_strength,
    next_strength,
)
from lerobot_agpd.guidance.teacher import History
from lerobot_agpd.guidance.teacher_student import TeacherStudent
from lerobot_agpd.replay.demonstrations import Batch
from lerobot_agpd.replay.replay import FRAME_INDEX
from lerobot_agpd.rollout.diagnostics import RoundDiagnostics
from lerobot_agpd.rollout.report import RoundReport, log_round, read_reports, round_scalars, success_rate
from lerobot_agpd.rollout.seeds import STUDENT_NOISE_STREAM
from lerobot_agpd.rollout.strategies import (
    ChunkBatch,
    MixingStrategy,
    NearestStrategy,
    RollInStrategy,
    Strategy,
    TeacherStrategy,
    unknown,
)
from lerobot_agpd.rollout.success import classify
from lerobot_agpd.student import PriorChunk, Student, StudentSampler

logger = logging.getLogger(__name__)

ADVERSARY_LOG = ("discriminator_loss", "adversarial_loss", "discriminator_accuracy")


# ---- stage 1: guided collection ----


class GuidedStrategy(Strategy):
    """The teacher denoises, pulled toward the chunk that the student proposes (Eq. 19-20)."""

    def __init__(self, pair: TeacherStudent, generator: torch.Generator, config: GuidanceConfig):
        super().__init__(pair, generator)
        self.config = config
        # The teacher stays as it is for a round: k is solved once per strength, not at every decision.
        self._scale_of = cache(lambda strength: guidance_scale(pair.teacher, strength, config))

    def act(self, history: History, strength: Tensor, student_acts: Tensor | None = None) -> ChunkBatch:
        """Guided chunks; `strength` is the pull (or scale), rows at 0 are the teacher's own bit for bit."""
        chunk_hat = self.pair.propose(history)  # A_hat = pi_phi(O), Eq. 19: (B, S, A), student-normalized
        action_j = self.pair.action_discrepancy(chunk_hat)
        guide = None
        if bool((strength > 0).any()):  # else the teacher need not be one that can be guided
            discrepancy = self.pair.guiding_discrepancy(history, chunk_hat, action_j)  # J(., A_hat)
            scale = guidance_scales(strength, self._scale_of)  # k
            guide = Guide(discrepancy, scale.to(chunk_hat.device), at=self.config.at)
        actions = self.pair.teacher_actions(history, self.generator, guide)  # Eq. 20: (B, n, A), raw
        shift = unknown(actions).to(chunk_hat.device)
        if guide is not None and guide.shift_in_sigmas:
            mean_shift = torch.stack(guide.shift_in_sigmas).mean(dim=0)  # (B,)
            shift = torch.where(guide.scale.to(mean_shift) > 0, mean_shift, torch.nan)
        return ChunkBatch(
            actions,
            discrepancy=self.pair.executed_discrepancy(actions, action_j.target),
            guidance_shift=shift,
        )


def make_strategy(config: StudentConfig, pair: TeacherStudent, generator: torch.Generator) -> Strategy:
    """The strategy that `config.collect` names: AGPD's, or one that it is compared with."""
    if config.collect.strategy == "teacher":
        return TeacherStrategy(pair, generator)
    if config.collect.strategy == "mixing":
        return MixingStrategy(pair, generator, config.collect.mixing)
    if config.collect.strategy == "nearest":
        return NearestStrategy(pair, generator)
    guided = GuidedStrategy(pair, generator, config.guidance)
    return RollInStrategy(guided) if config.collect.strategy == "rollin" else guided


def rounds_due(step: int, config: CollectConfig) -> int:
    """Rounds that are due after a number of training steps: the first after the warm-up, then one every `every`."""
    if not config.enabled or step < config.warmup:
        return 0
    due = 1 + (step - config.warmup) // config.every
    return due if config.rounds is None else min(due, config.rounds)


# ---- stage 2: training ----


@dataclass(frozen=True)
class Losses:
    """What AGPD adds to L_IL: a loss to be minimized, and its terms for the log."""

    total: Tensor
    log: dict[str, float]


class AGPD:
    """The two stages and their alternation, for one student in training.

    Args:
        student: the policy in training.
        parts: teacher, replay, collector and the rest, as `build.build_parts` makes them.
    """

    def __init__(self, student: Student, parts: Parts):
        self.student = student
        self.config = student.config
        self.run, self.progress = parts.run, parts.progress
        self.replay, self.references = parts.replay, parts.references
        self.teacher_chunks, self.frame_features = parts.teacher_chunks, parts.frame_features
        self.teacher, self.self_teacher = parts.teacher, parts.self_teacher
        self.collector, self.journal = parts.collector, parts.journal
        self.seed, self.rank = parts.seed, parts.rank
        self.reports = list(parts.reports)
        self._round_log = round_scalars(self.reports)
        self._micro_batch = 0  # since the last update, if gradients are accumulated

    # ---- the alternation ----

    def after_update(self) -> bool:
        """Count an optimizer step, and grow T if a round is due; runs on every process.

        Returns:
            Whether this was the last step of the run.
        """
        before, self.progress.step = self.progress.step, self.progress.step + self.run.steps_per_update
        due = rounds_due(self.progress.step, self.config.collect)
        is_last = self.progress.step + self.run.steps_per_update > (self.run.steps or math.inf)
        # None after the last step, because no student would learn from it.
        if due > rounds_due(before, self.config.collect) and due > len(self.reports) and not is_last:
            self.grow()
        return is_last

    def grow(self) -> RoundReport:
        """Add the next round to T: one that a killed run had finished is used again, any other is collected."""
        assert self.journal is not None
        number = len(self.reports)
        again = self.journal.is_finished(number)
        if not again:
            self.collect_round(number)
        elif self.self_teacher is not None:
            self.teacher = self.self_teacher.refresh(self.replay.demonstrations.normalizer.stats)
        self.replay.extend(self.journal.kept(number))  # T += episodes
        self.reports.append(read_reports(self.journal.root)[number])
        self.progress.rounds = len(self.reports)
        self._round_log = round_scalars(self.reports)
        if PartialState().is_main_process:
            log_round(self.reports[-1], again)
        return self.reports[-1]

    # ---- stage 1 ----

    @property
    def strength(self) -> float:
        """Pull (or guidance scale) of the next round's guided episodes."""
        if self.reports:
            return self.reports[-1].next_strength
        assert self.teacher is not None
        return first_strength(self.teacher, self.config.guidance)

    def collect_round(self, number: int) -> None:
        """One round into the journal: every process rolls out its part and keeps what succeeds."""
        assert self.collector is not None and self.journal is not None
        processes, was_training = PartialState(), self.student.training
        if not self.reports and self.run.output_dir and processes.is_main_process:
            logger.info(announcement(self.run.output_dir, self.journal.root))
        self.student.eval()
        with seeded_context(self.collector.stream_seed(number, STUDENT_NOISE_STREAM)):
            strategy = self._strategy(number)
            strength = self._episode_strength()
            # What rank 0 finds, before any process adds to it: every process must share out the same rest.
            (done,) = broadcast_object_list([{record.number for record in self.journal.records(number)}])
            for episode in self.collector.roll_out(number, strength, strategy, done):  # execute
                with strategy.stopwatch.measure("writing"):
                    record = classify(episode, self.config.collect)  # success filter
                    self.journal.append(number, self.rank, episode, record)
        processes.wait_for_everyone()
        self.collector.require_valid_episodes(number)
        if processes.is_main_process:
            self.journal.finish(number, self._report(number, strength, strategy).to_json())
        self.student.train(was_training)
        processes.wait_for_everyone()

    def _strategy(self, number: int) -> Strategy:
        """The configured strategy for a round, with the teacher and the student as they are now."""
        assert self.collector is not None
        normalizer, acting = self.replay.demonstrations.normalizer, None
        if self.self_teacher is not None:
            self.teacher = self.self_teacher.refresh(normalizer.stats)
            acting = self.self_teacher.previous
        assert self.teacher is not None
        pair = StudentSampler(self.student, normalizer, acting).pair_with(self.teacher)
        return make_strategy(self.config, pair, self.collector.noise(number))

    def _episode_strength(self) -> float:
        """Pull (or scale), mixing weight or number of samples of a round's episodes; 0: the teacher alone."""
        collect = self.config.collect
        strengths = {"mixing": collect.mixing.weight, "nearest": collect.nearest_samples, "teacher": 0.0}
        has_target = self.self_teacher is None or self.self_teacher.previous is not None
        return float(strengths.get(collect.strategy, self.strength)) if has_target else 0.0

    def _report(self, number: int, strength: float, strategy: Strategy) -> RoundReport:
        assert self.collector is not None and self.journal is not None and self.teacher is not None
        guides = self.config.collect.guides and strength > 0
        diagnostics = self.collector.diagnose(number, strength, strategy)
        report = RoundReport.of(
            self.journal.records(number),
            round=number,
            step=self.progress.step,
            strength=strength,
            next_strength=self.strength,
            guidance_scale=guidance_scale(self.teacher, strength, self.config.guidance) if guides else None,
            seconds=dict(strategy.stopwatch.seconds),
            teacher_samples=self._teacher_samples(strategy, diagnostics),
            diagnostics=diagnostics,
        )
        if not self.config.collect.guides:
            return report
        return replace(report, next_strength=self._adapted_strength(report))

    def _teacher_samples(self, strategy: Strategy, diagnostics: RoundDiagnostics | None) -> dict[str, int]:
        return {
            "collection": strategy.stopwatch.counts.get("teacher", 0),
            "diagnostics": diagnostics.teacher_samples if diagnostics else 0,
            "references": self.references.take_sample_count(),
        }

    def _adapted_strength(self, report: RoundReport) -> float:
        # A frozen teacher's own rate is best known from all rounds; one that still learns has only its newest.
        rounds = [report] if self.self_teacher else [*self.reports, report]
        guided_success = success_rate([report.strategy])
        teacher_success = success_rate(entry.teacher_only for entry in rounds)
        assert self.teacher is not None
        reachable = largest_strength(self.teacher, self.config.guidance)
        return next_strength(self.strength, guided_success, teacher_success, self.config.guidance, reachable)

    # ---- stage 2 ----

    def train_batch(self, batch: Batch) -> Batch:
        """A batch of T: the loader's frames, a fraction exchanged for collected ones."""
        self.replay.observe(batch)
        generator = self._generator(self.progress.step + self._micro_batch)
        self._micro_batch = (self._micro_batch + 1) % self.run.steps_per_update
        batch = self.replay.train_batch(batch, generator)
        if self.teacher_chunks is None or self.config.replay.relabel == "none":
            return batch
        return self.teacher_chunks.relabel(batch, self.config)

    def _generator(self, *numbers: int) -> torch.Generator:
        """Random numbers of a training step; they have no state, so that a resumed run draws the same."""
        return torch.Generator().manual_seed(hash((self.seed, self.rank, *numbers)) % 2**63)

    def adversary_batch(self, batch: Batch) -> AdversaryBatch | None:
        """The teacher's chunks at recorded observations; None where the adversary does not act at this step."""
        config, step = self.config.adversary, self.progress.step
        if config.weight == 0 or step < config.start or (step // self.run.steps_per_update) % config.every:
            return None
        return self.references.batch(batch, len(self.reports), self._generator(step, self._micro_batch))

    def losses(
        self,
        batch: Batch,
        reference: AdversaryBatch | None,
        prior: PriorChunk | None,
        discriminator: Discriminator | None,
    ) -> Losses:
        """What AGPD adds to L_IL on a batch of T: s * L_AIL with D's own loss (Eq. 21-22), and L_recon (A.4).

        Args:
            batch: of `train_batch`.
            reference: of `adversary_batch`.
            prior: the student's chunk and embedding at the reference's frames; None without frames.
            discriminator: D.
        """
        total = torch.zeros((), device=batch[ACTION].device)
        log = {"collected_fraction": self.replay.collected_fraction} | self._round_log
        if reference is not None:
            # LeRobot averages over processes by position: every one needs the same keys.
            log |= dict.fromkeys(ADVERSARY_LOG, 0.0)
        if reference is not None and prior is not None and discriminator is not None:
            mask = reference.compared[..., None]
            terms = adversary_terms(
                discriminator,
                prior.chunk * mask,
                reference.chunk * mask,
                prior.embedding,
                self.config.adversary.weight,
            )
            total = total + terms.loss
            log |= zip(
                ADVERSARY_LOG, (terms.loss.item(), terms.log_d.item(), terms.accuracy.item()), strict=True
            )
        if self.student.representation is not None:
            representation, frames = self.student.representation, batch[FRAME_INDEX]
            if self.frame_features is None:
                keys = self.config.observed_vectors
                future = self.replay.executed_future(frames, keys, representation.n_steps)
            else:
                future = self.replay.visual_future(frames, self.frame_features, representation.n_steps)
            predicted = representation(future.observation, future.actions)  # O_hat_{t+n}
            recon = reconstruction_loss(predicted, future.later, future.is_pad)
            total = total + WEIGHT * recon
            log["representation_loss"] = recon.item()
        return Losses(total, log)

    # ---- checkpoints ----

    def save(self, folder: Path) -> None:
        """Write what a resumed run must know beside a checkpoint's weights."""
        self.progress.seen_episodes = sorted(self.replay.seen_episodes)
        self.progress.save(folder)
        if self.self_teacher is not None:
            self.self_teacher.save(folder)
