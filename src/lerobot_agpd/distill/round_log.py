"""Collection rounds as scalars for the training log, and as a line for the console."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_agpd.collect.report import success_rate

logger = logging.getLogger(__name__)

KINDS = ("guided", "unguided", "retried")
DIAGNOSTICS = {
    "actions": ("rms_to_student", "rms_to_teacher", "kl_to_teacher_median"),
    "states": ("entropy", "coverage"),
}


def round_scalars(reports: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """What the training log says of the rounds so far; counts of episodes are sums over all of them."""
    scalars = {"rounds": float(len(reports))}
    if not reports:
        return scalars
    last = reports[-1]
    scalars["scale"] = float(last["scale"])
    for kind in KINDS:
        # Rounds of earlier versions have no retries.
        rate = success_rate([last[kind]]) if kind in last else None
        if rate is not None:
            scalars[f"{kind}_success"] = rate
    for key in ("generated", "successful", "kept"):
        scalars[f"episodes_{key}"] = float(sum(report[key] for report in reports))
    for key in ("mean_j_guided", "mean_shift_in_sigmas"):
        if last[key] is not None:
            scalars[key.removeprefix("mean_")] = last[key]
    diagnostics = last.get("diagnostics") or {}
    for part, names in DIAGNOSTICS.items():
        values = diagnostics.get(part) or {}
        scalars |= {f"{part}_{name}": values[name] for name in names if values.get(name) is not None}
    return scalars


def log_round(report: Mapping[str, Any]) -> None:
    """Say on the console what a round brought."""
    rates = {kind: success_rate([report[kind]]) for kind in KINDS}
    shown = {kind: "-" if rate is None else f"{rate:.2f}" for kind, rate in rates.items()}
    logger.info(
        "round %d: %d generated, %d successful, %d kept; success guided %s, unguided %s, of failed starts %s; scale %.3g -> %.3g; %.0f s",
        report["round"],
        report["generated"],
        report["successful"],
        report["kept"],
        shown["guided"],
        shown["unguided"],
        shown["retried"],
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
