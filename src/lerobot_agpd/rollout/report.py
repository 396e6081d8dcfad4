"""What a collection round produced, in numbers."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_agpd.replay.episode import EpisodeRecord
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.rollout.diagnostics import RoundDiagnostics

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Tally:
    """Counts of episodes; successes are those of valid episodes that were not solved at the start."""

    generated: int
    solved_at_start: int
    successful: int
    kept: int
    invalid: int = 0

    @classmethod
    def of(cls, records: Iterable[EpisodeRecord]) -> Tally:
        """Count records."""
        records = list(records)
        valid = [record for record in records if not record.invalid]
        counted = [record for record in valid if not record.solved_at_start]
        return cls(
            generated=len(records),
            solved_at_start=len(valid) - len(counted),
            successful=sum(record.success for record in counted),
            kept=sum(record.kept for record in records),
            invalid=len(records) - len(valid),
        )

    @property
    def counted(self) -> int:
        """Valid episodes that were not solved at the start: those that a success rate is over."""
        return self.generated - self.solved_at_start - self.invalid


def success_rate(tallies: Iterable[Tally]) -> float | None:
    """Success rate over the valid episodes of several tallies that were not solved at the start; None without any."""
    tallies = list(tallies)
    counted = sum(tally.counted for tally in tallies)
    return sum(tally.successful for tally in tallies) / counted if counted else None


@dataclass(frozen=True)
class RoundReport:
    """A collection round in numbers.

    Rates of success are those of new starts: failed ones that are tried again are harder, and have their own count.

    Attributes:
        round: number, counted from 0.
        strength: pull, guidance scale (where that flag is given), mixing weight or number of samples of its episodes.
        guidance_scale: guidance scale k of its guided episodes; None if nothing was guided.
        next_strength: pull, or guidance scale, of the next round's guided episodes.
        step: training step after which it was collected.
        total: all episodes.
        strategy: those that the strategy decided.
        teacher_only: those of the teacher alone (with rollin: after the student's part).
        retried: those that started again where earlier ones had failed.
        student_alone: those that ended before the teacher took over (rollin).
        kept_frames: frames that entered T.
        mean_max_reward: over all episodes.
        mean_discrepancy: action J between executed and student's chunks, of the strategy's episodes; None if unknown.
        mean_discrepancy_teacher_only: the same of the teacher's.
        mean_guidance_shift: shift of the guided denoising steps in sigmas; None if nothing was guided.
        mean_student_steps: steps of the student's part (rollin).
        seconds: spent by one process, by activity.
        teacher_samples: chunks that one process sampled of the teacher: for `collection`, for `diagnostics`, and since the
            round before for `references` (of the adversary, or for relabeling).
        diagnostics: what the strategy did to actions and states; None if not measured.
    """

    round: int
    strength: float
    next_strength: float
    step: int
    total: Tally
    strategy: Tally
    teacher_only: Tally
    retried: Tally
    student_alone: Tally
    kept_frames: int
    mean_max_reward: float | None
    mean_discrepancy: float | None
    mean_discrepancy_teacher_only: float | None
    mean_guidance_shift: float | None
    mean_student_steps: float | None
    guidance_scale: float | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    teacher_samples: Mapping[str, int] = field(default_factory=dict)
    diagnostics: RoundDiagnostics | None = None

    @classmethod
    def of(cls, records: Sequence[EpisodeRecord], **facts: Any) -> RoundReport:
        """Summarize the records of a round; `facts` are the fields that records do not hold."""
        with_teacher = [record for record in records if not record.student_alone]
        new = [record for record in with_teacher if not record.retry]
        strategy = [record for record in new if record.strength > 0]
        teacher_only = [record for record in new if record.strength == 0]
        return cls(
            total=Tally.of(records),
            strategy=Tally.of(strategy),
            teacher_only=Tally.of(teacher_only),
            retried=Tally.of(record for record in records if record.retry),
            student_alone=Tally.of(record for record in records if record.student_alone),
            kept_frames=sum(record.length for record in records if record.kept),
            mean_max_reward=_mean(record.max_reward for record in records),
            mean_discrepancy=_mean(record.discrepancy for record in strategy),
            mean_discrepancy_teacher_only=_mean(record.discrepancy for record in teacher_only),
            mean_guidance_shift=_mean(record.guidance_shift for record in strategy),
            mean_student_steps=_mean(record.student_steps for record in with_teacher),
            **facts,
        )

    def to_json(self) -> dict[str, Any]:
        """A JSON object."""
        return asdict(self)

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> RoundReport:
        """The inverse of `to_json`."""
        tallies = ("total", "strategy", "teacher_only", "retried", "student_alone")
        measured = entry["diagnostics"]
        diagnostics = RoundDiagnostics(**measured) if measured else None
        return cls(
            **{**entry, **{name: Tally(**entry[name]) for name in tallies}, "diagnostics": diagnostics}
        )

    @property
    def scalars(self) -> dict[str, float]:
        """What the training log says of this round."""
        rates = {
            "strategy_success": success_rate([self.strategy]),
            "teacher_only_success": success_rate([self.teacher_only]),
            "retried_success": success_rate([self.retried]),
            "mean_discrepancy": self.mean_discrepancy,
            "mean_guidance_shift": self.mean_guidance_shift,
            "guidance_scale": self.guidance_scale,
        }
        measured = self.diagnostics.scalars if self.diagnostics else {}
        known = {name: value for name, value in rates.items() if value is not None}
        return {"strength": self.strength, **known, **measured}


def read_reports(root: Path) -> list[RoundReport]:
    """Reports of the finished rounds in a folder of collected episodes, in order."""
    return [RoundReport.from_json(report) for report in EpisodeJournal(root).reports()]


def round_scalars(reports: Sequence[RoundReport]) -> dict[str, float]:
    """What the training log says of the rounds so far: the last one, and episodes summed over all."""
    scalars = {"rounds": float(len(reports))}
    if reports:
        scalars |= reports[-1].scalars
        for count in ("generated", "successful", "kept"):
            scalars[f"episodes_{count}"] = float(sum(getattr(report.total, count) for report in reports))
    return scalars


def log_round(report: RoundReport, again: bool = False) -> None:
    """Say on the console what a round brought.

    Args:
        report: of the round.
        again: whether it was collected before the run was interrupted.
    """
    tallies = (report.strategy, report.teacher_only, report.retried)
    rates = [success_rate([tally]) for tally in tallies]
    shown = ["-" if rate is None else f"{rate:.2f}" for rate in rates]
    logger.info(
        "round %d%s: %d episodes, %d invalid, %d successful, %d kept; success of the strategy %s, of the teacher alone %s, "
        "of failed starts %s; strength %.3g, next %.3g; %.0f s",
        report.round,
        " (collected before the interruption)" if again else "",
        report.total.generated,
        report.total.invalid,
        report.total.successful,
        report.total.kept,
        *shown,
        report.strength,
        report.next_strength,
        sum(report.seconds.values()),
    )
    total = report.total
    if total.solved_at_start and total.solved_at_start == total.generated - total.invalid:
        logger.warning(
            "round %d kept no episode: all %d were solved at the start, so there is nothing to learn from them. The "
            "environment reports success at its first step (is_success in its info, or a reward of at least "
            "--policy.collect.min_reward)",
            report.round,
            total.solved_at_start,
        )
    elif total.kept == 0:
        logger.warning(
            "round %d kept no episode: the student goes on with what it has. If this persists, the teacher is too "
            "weak or the success filter too strict (--policy.collect.min_reward)",
            report.round,
        )


def _mean(values: Iterable[float]) -> float | None:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else None
