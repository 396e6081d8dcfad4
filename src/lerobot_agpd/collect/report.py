"""What a collection round produced, in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lerobot_agpd.replay.episode import EpisodeRecord


def tally(records: Sequence[EpisodeRecord]) -> dict[str, int]:
    """Generated, successful and kept episodes; successes count among the non-trivial ones only."""
    counted = [record for record in records if not record.trivial]
    return {
        "generated": len(records),
        "trivial": len(records) - len(counted),
        "successful": sum(record.passed for record in counted),
        "kept": sum(record.kept for record in records),
    }


def success_rate(counts: Sequence[dict[str, int]]) -> float | None:
    """Success rate over the non-trivial episodes of several tallies; None if there were none."""
    counted = sum(count["generated"] - count["trivial"] for count in counts)
    return sum(count["successful"] for count in counts) / counted if counted else None


def summarise(records: Sequence[EpisodeRecord]) -> dict[str, Any]:
    """The numbers of a round: episodes with guidance (or mixing), the teacher's own, and the student's own.

    Rates of success are those of new starts: failed ones that are tried again are harder, and have their own count.
    """
    with_teacher = [record for record in records if not record.student_alone]
    guided = [record for record in with_teacher if record.scale > 0 and not record.retry]
    unguided = [record for record in with_teacher if record.scale == 0 and not record.retry]
    return {
        **tally(records),
        "guided": tally(guided),
        "unguided": tally(unguided),
        "retried": tally([record for record in records if record.retry]),
        "student_alone": tally([record for record in records if record.student_alone]),
        "mean_max_reward": _mean([record.max_reward for record in records]),
        "mean_j_guided": _mean([record.j for record in guided]),
        "mean_j_unguided": _mean([record.j for record in unguided]),
        "mean_shift_in_sigmas": _mean([record.shift for record in guided]),
        "mean_student_steps": _mean([record.student_steps for record in with_teacher]),
        "kept_frames": sum(record.length for record in records if record.kept),
        "episodes": [record.to_json() for record in records],
    }


def _mean(values: Sequence[float]) -> float | None:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else None
