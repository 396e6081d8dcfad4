"""Rows of the tables in every report; the header is the first row."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from rich.table import Table

from lerobot_agpd.rollout.report import RoundReport, Tally, success_rate
from lerobot_agpd.studies.evaluation import MEASURES
from lerobot_agpd.studies.matrix import LABELS
from lerobot_agpd.studies.results import (
    CHECKPOINTS,
    Methods,
    Result,
    RunResult,
    counts,
    difference,
    pooled,
)
from lerobot_agpd.studies.ways import RoundWays

Row = tuple[str, ...]

RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")

DISTANCES = {
    "rms to the teacher": ("rms_to_teacher", "{:.3f}"),
    "rms to the student": ("rms_to_student", "{:.3f}"),
    "rms teacher to student": ("rms_teacher_to_student", "{:.3f}"),
    "spread of the teacher": ("teacher_spread", "{:.3f}"),
    "KL to the teacher": ("kl_to_teacher_median", "{:.2f}"),
}
"""Columns about the executed actions: key in a round's diagnostics, and format."""


def markdown(rows: Iterable[Sequence[str]]) -> str:
    """A table in markdown."""
    header, *body = rows
    lines = [header, ["---"] * len(header), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def console_table(rows: Iterable[Sequence[str]]) -> Table:
    """A table for the console."""
    header, *body = rows
    table = Table(*header)
    for row in body:
        table.add_row(*row)
    return table


# ---- the report of some runs ----


def summary_table(results: Sequence[Result]) -> list[Row]:
    """One row per result, with 95 % intervals over its episodes."""
    rows: list[Row] = [
        ("", "success", "mean max reward", "N", "episodes generated / kept", "parameters", "ms per chunk")
    ]
    for result in results:
        episodes = counts([result])
        rows.append(
            (
                result.name,
                str(pooled([result], "last", "success")),
                str(pooled([result], "last", "max_reward")),
                str(len(result.finals["last"].successes)),
                f"{episodes['generated']} / {episodes['kept']}" if result.rounds else "-",
                f"{result.latency.n_parameters / 1e6:.2f} M",
                f"{result.latency.median_ms:.1f}",
            )
        )
    return rows


# ---- a comparison ----


def outcome_table(methods: Methods, measure: str, reference: str | None) -> list[Row]:
    """What to look at first: the task's measure at the last checkpoint, and the difference to one method.

    Args:
        methods: a task's results.
        measure: what the task is measured by.
        reference: the method that the others are compared with; None: no such column.
    """
    rows: list[Row] = [("", "training seeds", "gradient steps", f"{LABELS[measure]}, last", "by seed")]
    if reference is not None:
        rows[0] += (f"minus `{reference}`",)
    for name, runs in methods.items():
        cells = _outcome(name, runs, measure, str(len(runs)))
        if reference is not None:
            cells.append(
                "" if name == reference else difference_cell(runs, methods[reference], "last", measure)
            )
        rows.append(tuple(cells))
    return rows


def _outcome(name: str, runs: Sequence[RunResult], measure: str, n_seeds: str) -> list[str]:
    """Name, training seeds, gradient steps, the measure at the last checkpoint, and the same by seed."""
    trained = runs[0].steps is not None
    by_seed = [f"{pooled([result], 'last', measure).mean:.2f}" for result in runs]
    return [
        name,
        n_seeds if trained else "-",
        str(runs[0].steps) if trained else "-",
        str(pooled(runs, "last", measure)),
        " / ".join(by_seed) if len(runs) > 1 else "-",
    ]


def results_table(methods: Methods, measure: str, n_seeds: int) -> list[Row]:
    """Everything that the methods achieved: the task's measure first, then the other one if it adds anything.

    Args:
        methods: a task's results.
        measure: what the task is measured by.
        n_seeds: training seeds that the comparison is to have.
    """
    others = [kind for kind in MEASURES if kind != measure and (kind == "success" or _reward_adds(methods))]
    label = LABELS[measure]
    header = ["", "training seeds", "gradient steps", f"{label}, last", "by seed", f"{label}, best"]
    header += [f"{LABELS[kind]}, {which}" for kind in others for which in reversed(CHECKPOINTS)]
    rows: list[Row] = [tuple(header)]
    for name, runs in methods.items():
        trained = runs[0].steps is not None
        cells = _outcome(name, runs, measure, f"{len(runs)} of {n_seeds}")
        cells.append(str(pooled(runs, "best", measure)) if trained else "-")
        for kind in others:
            cells += [str(pooled(runs, "last", kind)), str(pooled(runs, "best", kind)) if trained else "-"]
        rows.append(tuple(cells))
    return rows


def _reward_adds(methods: Methods) -> bool:
    """Whether the max rewards of the evaluations are more than success and a constant."""
    finals = [result.finals[which] for runs in methods.values() for result in runs for which in CHECKPOINTS]
    constants = [np.subtract(final.max_rewards, np.asarray(final.successes, float)) for final in finals]
    return bool(np.ptp(np.concatenate(constants)) > 1e-6)


def difference_table(methods: Methods, references: Sequence[str], checkpoint: str, measure: str) -> list[Row]:
    """Every method (row) minus every reference (column)."""
    rows: list[Row] = [("", *references)]
    for name, runs in methods.items():
        cells = (
            "" if other == name else difference_cell(runs, methods[other], checkpoint, measure)
            for other in references
        )
        rows.append((name, *cells))
    return rows


def difference_cell(
    runs: Sequence[RunResult], others: Sequence[RunResult], checkpoint: str, measure: str
) -> str:
    """E.g. `**+0.05 [+0.01, +0.09]**³`: bold if it excludes zero with several training seeds, their number raised."""
    estimate = difference(runs, others, checkpoint, measure)
    if estimate is None:
        return "-"
    seeds = raised(estimate.n_seeds)
    if estimate.low == estimate.high:  # no spread at all, which few environments may show by chance
        return f"{estimate.mean:+.2f}{seeds} (in every pair)"
    bold = estimate.excludes_zero and estimate.n_seeds > 1
    return f"**{estimate}**{seeds}" if bold else f"{estimate}{seeds}"


def raised(number: int) -> str:
    """A number of training seeds as table cells show it."""
    return str(number).translate(RAISED)


def cost_table(methods: Methods) -> list[Row]:
    """Episodes, training time and size of every method."""
    rows: list[Row] = [("", "episodes generated / successful / kept", "training time", "parameters")]
    for name, runs in methods.items():
        episodes = counts(runs)
        rows.append(
            (
                name,
                " / ".join(f"{value / len(runs):.0f}" for value in episodes.values())
                if episodes["generated"]
                else "-",
                training_time(runs) if any(result.steps is not None for result in runs) else "-",
                f"{runs[0].latency.n_parameters / 1e6:.2f} M",
            )
        )
    return rows


def training_time(runs: Sequence[RunResult]) -> str:
    """Mean wall-clock per run, e.g. `310 s: teacher 20, environment 90, training 200`; the rest is training."""
    activities = sorted({activity for result in runs for activity in result.seconds} - {"total"})
    spent = {
        activity: float(np.mean([result.seconds.get(activity, 0.0) for result in runs]))
        for activity in activities
    }
    total = float(np.mean([result.seconds["total"] for result in runs]))
    parts = [f"{activity} {seconds:.0f}" for activity, seconds in spent.items()]
    if parts:
        parts.append(f"training {max(0.0, total - sum(spent.values())):.0f}")
    return f"{total:.0f} s" + (f": {', '.join(parts)}" if parts else "")


# ---- collection rounds ----


def collection_table(methods: Methods) -> list[Row]:
    """What the rounds of every method that collected did to success, actions and states; empty without any."""
    rounds = {name: [round_ for result in runs for round_ in result.rounds] for name, runs in methods.items()}
    rows = [(name, *_collection_cells(entries)) for name, entries in rounds.items() if entries]
    header = ("", "success of the strategy", "of the teacher-only part", "shift in sigmas", *DISTANCES)
    header += ("state entropy", "state coverage", "seconds per round")
    return [header, *rows] if rows else []


def _collection_cells(rounds: Sequence[RoundReport]) -> Iterator[str]:
    for tallies in ([report.strategy for report in rounds], [report.teacher_only for report in rounds]):
        rate = success_rate(tallies)
        yield "-" if rate is None else f"{rate:.2f}"
    yield _mean([report.mean_guidance_shift for report in rounds], "{:.2f}")
    diagnostics = [report.diagnostics for report in rounds if report.diagnostics]
    for key, digits in DISTANCES.values():
        yield _mean([(entry.actions or {}).get(key) for entry in diagnostics], digits)
    for key in ("entropy", "coverage"):
        yield _mean([(entry.states or {}).get(key) for entry in diagnostics], "{:.2f}")
    yield _mean([sum(report.seconds.values()) for report in rounds], "{:.0f}")


def _mean(values: Sequence[float | None], digits: str) -> str:
    present = [value for value in values if value is not None]
    return digits.format(np.mean(present)) if present else "-"


def ways_table(methods: Methods) -> list[Row]:
    """Which way the kept episodes took: a row per method and training seed; empty in a task with one way."""
    runs = {
        f"{name}, {result.run.seed}": result.ways for name, results in methods.items() for result in results
    }
    longest = max((len(ways) for ways in runs.values()), default=0)
    rows: list[Row] = [("", *(f"round {number}" for number in range(longest)))]
    for name, ways in runs.items():
        cells = [f"{' '.join(map(str, round_.total))} ({round_.entropy:.2f})" for round_ in ways]
        if cells:
            rows.append((name, *cells, *[""] * (longest - len(cells))))
    return rows if longest else []


def round_ways_table(ways: Sequence[RoundWays]) -> list[Row]:
    """One row per collection round of a run: kept episodes on every way, and their entropy; empty without ways."""
    if not ways:
        return []
    header = ("round", *(f"way {way}" for way in range(len(ways[0].total))), "entropy")
    rows = [
        (str(number), *map(str, round_.total), f"{round_.entropy:.2f}") for number, round_ in enumerate(ways)
    ]
    return [header, *rows]


def rounds_table(rounds: Sequence[RoundReport]) -> list[Row]:
    """One row per collection round of a run."""
    rows: list[Row] = [
        ("round", "strength", "strategy", "teacher only", "generated", "kept", "shift in sigmas", "seconds")
    ]
    for report in rounds:
        shift = report.mean_guidance_shift
        rows.append(
            (
                str(report.round),
                f"{report.strength:.3g}",
                *(_successes(tally) for tally in (report.strategy, report.teacher_only)),
                str(report.total.generated),
                str(report.total.kept),
                "-" if shift is None else f"{shift:.2f}",
                f"{sum(report.seconds.values()):.0f}",
            )
        )
    return rows


def _successes(tally: Tally) -> str:
    return f"{tally.successful} / {tally.counted}" if tally.counted else "-"
