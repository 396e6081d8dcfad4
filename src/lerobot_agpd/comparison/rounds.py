"""What the collection rounds of every method did, beside how many episodes they kept: one table per task."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_agpd.collect.report import success_rate
from lerobot_agpd.comparison.results import RunResult

HEADER = (
    "",
    "success of the strategy",
    "of the unguided share",
    "shift in sigmas",
    "rms to the teacher",
    "rms to the student",
    "rms teacher to student",
    "spread of the teacher",
    "KL to the teacher",
    "state entropy",
    "state coverage",
    "seconds per round",
)

NOTE = """\
Collection, means over rounds and training seeds; success pools their episodes. It is that of the filter, which wants success
at the last step (or a reward) and leaves out starts that are solved already, so it is lower than in the evaluations. The
unguided share of every round is the teacher's alone, with `rollin` after the student's part. Distances are between executed
chunks, root mean square in the teacher's units, with teacher and strategy sampled from the same noise; the spread is the
standard deviation of the teacher's own samples at one observation (older rounds lack it); the KL divergence is that of
moment-matched Gaussians over single actions (Eq. 14), in nats, the median over observations. Entropy (nearest neighbours,
nats) and held-out coverage (P_S) are those of kept states, in standard deviations of the demonstrations.
"""


def collection_rows(methods: Mapping[str, Sequence[RunResult]]) -> list[tuple[str, ...]]:
    """One row per method that collected, in the order of HEADER."""
    return [
        (name, *_numbers([round_ for result in runs for round_ in result.rounds]))
        for name, runs in methods.items()
        if any(result.rounds for result in runs)
    ]


def _numbers(rounds: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    for part in ("guided", "unguided"):
        rate = success_rate([round_[part] for round_ in rounds])
        yield "-" if rate is None else f"{rate:.2f}"
    yield _mean([round_["mean_shift_in_sigmas"] for round_ in rounds], "{:.2f}")
    measured = [round_["diagnostics"] or {} for round_ in rounds]
    actions = [entry.get("actions") or {} for entry in measured]
    for key, digits in (
        ("rms_to_teacher", "{:.3f}"),
        ("rms_to_student", "{:.3f}"),
        ("rms_teacher_to_student", "{:.3f}"),
        ("teacher_spread", "{:.3f}"),
        ("kl_to_teacher_median", "{:.2f}"),
    ):
        yield _mean([entry.get(key) for entry in actions], digits)
    states = [entry.get("states") or {} for entry in measured]
    for key in ("entropy", "coverage"):
        yield _mean([entry.get(key) for entry in states], "{:.2f}")
    yield _mean([sum(round_["seconds"].values()) for round_ in rounds], "{:.0f}")


def _mean(values: Sequence[float | None], digits: str) -> str:
    known = [value for value in values if value is not None]
    return digits.format(np.mean(known)) if known else "-"
