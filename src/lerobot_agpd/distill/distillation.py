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
from lerobot.utils.random_utils import seeded_context
from torch import Tensor

from lerobot_agpd.collect.report import success_rate
from lerobot_agpd.collect.round import RoundRunner
from lerobot_agpd.collect.strategies import GuidedTeacher, TeacherAlone
from lerobot_agpd.distill.adversary import adversary_terms
from lerobot_agpd.distill.environment import check_environment_fits, run_environment
from lerobot_agpd.distill.guided import Proposer, executed_steps
from lerobot_agpd.distill.relabel import TeacherChunks
from lerobot_agpd.distill.schedule import due_round
from lerobot_agpd.distill.state import DistillationState, replay_root
from lerobot_agpd.guidance.controller import next_scale
from lerobot_agpd.guidance.representation import reconstruction_loss
from lerobot_agpd.guidance.teacher import DiffusionTeacher, check_teacher_fits, load_teacher
from lerobot_agpd.replay.memory import Batch, FrameMemory
from lerobot_agpd.replay.normalisation import Statistics
from lerobot_agpd.replay.replay import ROW, Replay
from lerobot_agpd.replay.store import ReplayStore
from lerobot_agpd.run import barrier, process_rank, this_run, world_size

if TYPE_CHECKING:
    from lerobot_agpd.distill.student import DistilledStudent

logger = logging.getLogger(__name__)


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
        self.rank, self.n_ranks = process_rank(), world_size()
        self.state = DistillationState.restore(self.config, self.run)
        memory = FrameMemory(self.config, dataset_meta, dataset_stats)
        self.demonstrations = memory.dataset.meta
        self.replay = Replay(memory, self.config, self.config.replay.collected_share)
        self.replay.seen_episodes.update(self.state.seen_episodes)
        self.teacher = self._load_teacher()
        self.rounds = self._make_rounds()
        self.teacher_chunks = self._make_teacher_chunks()
        self.reports: list[Mapping[str, Any]] = []
        self._adopt_finished_rounds()

    # ---- setting up ----

    @property
    def needs_teacher(self) -> bool:
        """Whether any part of the method uses the teacher."""
        return self.config.collect.enabled or self.config.adversary.weight > 0

    def _load_teacher(self) -> DiffusionTeacher | None:
        if not self.needs_teacher:
            return None
        teacher = load_teacher(self.config.teacher, self.config.device)
        check_teacher_fits(
            teacher, self.student.demonstrated_features(self.demonstrations), self.config.action_feature
        )
        return teacher

    def _make_rounds(self) -> RoundRunner | None:
        if not self.config.collect.enabled:
            return None
        assert self.teacher is not None
        env_config = run_environment(self.config.collect, self.run)
        check_environment_fits(env_config, self.config, self.teacher)
        root = replay_root(self.config.replay, self.run, self.state)
        self.state.replay_root = str(root)
        return RoundRunner(
            store=ReplayStore(root),
            env_config=env_config,
            policy_config=self.config,
            demonstrations=self.demonstrations,
            seed=self.seed,
            rank=self.rank,
            n_ranks=self.n_ranks,
        )

    def _make_teacher_chunks(self) -> TeacherChunks | None:
        if self.config.adversary.weight == 0:
            return None
        assert self.teacher is not None
        return TeacherChunks(self.teacher, self.replay, self.config.chunk_size, self.seed)

    def _adopt_finished_rounds(self) -> None:
        """Load the rounds on disk: those of the checkpoint, and those finished after it was written."""
        if self.rounds is None:
            return
        finished = self.rounds.store.rounds()
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
        return self.replay.training_rows(batch, generator)

    def held_out_rows(self, batch: Batch) -> Batch:
        """A batch of demonstrations alone."""
        self.replay.memory.observe(batch)
        return self.replay.demonstration_rows(batch)

    # ---- stage 1: guided collection ----

    @property
    def scale(self) -> float:
        """Guidance scale of the next round."""
        if self.config.collect.strategy == "replay":
            return 0.0
        return float(self.reports[-1]["next_scale"]) if self.reports else self.config.guidance.scale

    def collect_round(self) -> Mapping[str, Any]:
        """One round: every process rolls out its share, successes become part of T."""
        assert self.rounds is not None
        number, was_training = len(self.reports), self.student.training
        self.student.eval()
        with seeded_context(self.seed):
            records, seconds = self.rounds.collect(number, self.scale, self._make_decider(number))
        self.student.train(was_training)
        if self.rank == 0:
            self.rounds.finish(number, self._report(number, records, seconds))
        barrier()
        round_ = self.rounds.store.rounds()[number]
        for dataset in round_.datasets:
            self.replay.add_dataset(dataset)
        self.reports.append(round_.report)
        self.state.rounds = len(self.reports)
        if self.rank == 0:
            _log_round(round_.report)
        return round_.report

    def _make_decider(self, number: int) -> GuidedTeacher | TeacherAlone:
        assert self.teacher is not None and self.rounds is not None
        noise = self.rounds.noise(number)
        if self.config.collect.strategy == "replay":
            return TeacherAlone(self.teacher, executed_steps(self.config, self.teacher), noise)
        return Proposer(self.student, self.replay.memory.normaliser).guided(self.teacher, noise)

    def _report(self, number: int, records: Any, seconds: Mapping[str, float]) -> dict[str, Any]:
        assert self.rounds is not None
        report = self.rounds.report(number, self.scale, records, seconds)
        report["updates"] = self.state.updates
        report["next_scale"] = self.scale
        if self.config.collect.strategy == "guided":
            report["next_scale"] = next_scale(
                self.scale,
                success_rate([report["guided"]]),
                success_rate([past["unguided"] for past in (*self.reports, report)]),
                self.config.guidance,
            )
        return report

    # ---- stage 2: training ----

    def extra_losses(self, rows: Batch) -> tuple[Tensor, dict[str, float]]:
        """What AGPD adds to L_IL on rows of T: the adversarial game and the representation's loss."""
        total = torch.zeros((), device=rows["action"].device)
        log: dict[str, float] = {}
        for loss, entries in (self._adversarial_loss(rows), self._representation_loss(rows)):
            total = total + loss
            log |= entries
        return total, log | self._round_log()

    def _adversarial_loss(self, rows: Batch) -> tuple[Tensor | float, dict[str, float]]:
        config, updates = self.config.adversary, self.state.updates
        if self.teacher_chunks is None or updates < config.start or updates % config.every:
            return 0.0, {}
        assert self.student.discriminator is not None
        teacher_chunk, shared = self.teacher_chunks.at(rows[ROW], self.replay.seen_episodes)
        student_chunk, embedding = self.student.prior_chunk(rows)
        shared_steps = torch.arange(student_chunk.shape[1], device=student_chunk.device) < shared
        terms = adversary_terms(
            self.student.discriminator,
            student_chunk * shared_steps[:, None],
            teacher_chunk,
            embedding,
            config,
        )
        return terms.discriminator + terms.student, {
            "discriminator_loss": terms.discriminator.item(),
            "adversarial_loss": terms.log_d.item(),
            "discriminator_accuracy": terms.accuracy.item(),
        }

    def _representation_loss(self, rows: Batch) -> tuple[Tensor | float, dict[str, float]]:
        representation = self.student.representation
        if representation is None:
            return 0.0, {}
        n_steps = representation.n_steps
        now, later, is_pad = self.replay.executed_future(rows[ROW], self.replay.vector_keys, n_steps)
        predicted = representation(now, rows["action"][:, :n_steps])
        loss = reconstruction_loss(predicted, later, is_pad)
        return self.config.representation.weight * loss, {"representation_loss": loss.item()}

    def _round_log(self) -> dict[str, float]:
        log = {"collected_share": self.replay.share(), "rounds": float(len(self.reports))}
        if self.reports:
            report = self.reports[-1]
            log["guidance_scale"] = self.scale
            for kind in ("guided", "unguided"):
                rate = success_rate([report[kind]])
                if rate is not None:
                    log[f"{kind}_success"] = rate
            for key in ("generated", "successful", "kept"):
                log[f"episodes_{key}"] = float(sum(past[key] for past in self.reports))
            for key in ("mean_j_guided", "mean_shift_in_sigmas"):
                if report[key] is not None:
                    log[key.removeprefix("mean_")] = report[key]
        return log

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
        """Write the counters beside a checkpoint's weights."""
        self.state.save(folder)


def _log_round(report: Mapping[str, Any]) -> None:
    rates = {kind: success_rate([report[kind]]) for kind in ("guided", "unguided")}
    shown = {kind: "-" if rate is None else f"{rate:.2f}" for kind, rate in rates.items()}
    logger.info(
        "round %d: %d generated, %d successful, %d kept; success guided %s, unguided %s; scale %.3g -> %.3g; %.0f s",
        report["round"],
        report["generated"],
        report["successful"],
        report["kept"],
        shown["guided"],
        shown["unguided"],
        report["scale"],
        report["next_scale"],
        sum(report["seconds"].values()),
    )
    if report["kept"] == 0:
        logger.warning(
            "round %d kept no episode: the student goes on with what it has. If this persists, the teacher is too "
            "weak or the success filter too strict (--policy.collect.min_reward)",
            report["round"],
        )
