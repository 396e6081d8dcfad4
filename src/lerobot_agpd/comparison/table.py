"""The comparison in words: one table of methods and one of their paired differences per task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lerobot_agpd.analysis.statistics import mean, success_rate
from lerobot_agpd.comparison.matrix import Matrix
from lerobot_agpd.comparison.results import CHECKPOINTS, RunResult, compare, counts
from lerobot_agpd.comparison.rounds import (
    HEADER as COLLECTION_HEADER,
    NOTE as COLLECTION_NOTE,
    collection_rows,
)

Methods = Mapping[str, Sequence[RunResult]]
"""Method to its results, one per training seed."""

HEADER = (
    "",
    "gradient steps",
    "success, best",
    "success, last",
    "by seed",
    "mean max reward, best",
    "mean max reward, last",
    "N",
    "episodes generated / successful / kept",
    "training time",
    "parameters",
    "ms per chunk",
)

NOTES = """\
Success counts at any step of an episode, as LeRobot evaluates. `last` is the checkpoint after the last gradient step,
`best` the one with the highest {measure} over {curve_episodes} environments (seeds from {curve_seed}), as in the
paper's appendix C; both are then evaluated on the same {episodes} other environments (seeds from {seed}), which
neither training, collection nor the choice of the checkpoint used. N pools all training seeds; its intervals
(Wilson, Student's t; 95 %) treat episodes as independent and therefore say nothing about another training seed.
Compare methods by the paired differences: row minus column, over the same training seeds and environments, with a 95 % t
interval for training seeds and environments as crossed random factors (Satterthwaite's degrees of freedom). With three
training seeds its factor is up to 4.3, so small differences are not told apart; with one, it does not cover training
seeds at all. Bold: the interval excludes zero. Nothing is adjusted for the number of comparisons. Episodes and times are
means per training seed; times were taken on a machine that may have run other jobs beside.
"""


def report(matrix: Matrix, results: Mapping[str, Methods], missing: Sequence[str]) -> str:
    """The whole report in markdown."""
    entry = matrix.evaluation
    parts = []
    for task, methods in results.items():
        measure = matrix.tasks[task].measure
        parts.append(f"## {matrix.tasks[task].title or task}")
        parts.append(_markdown(HEADER, [method_row(name, runs) for name, runs in methods.items()]))
        for which in CHECKPOINTS if len(methods) > 1 else ():
            parts.append(f"Paired differences in {_words(measure)}, {which} checkpoint (row minus column):")
            parts.append(_markdown(("", *methods), difference_rows(methods, which, measure)))
        notes = NOTES.format(
            measure=_words(measure),
            curve_episodes=entry.curve_episodes,
            curve_seed=entry.curve_seed,
            episodes=entry.episodes,
            seed=entry.seed,
        )
        parts.append(notes.replace("\n", " ").rstrip())
        if rows := collection_rows(methods):
            parts.append(_markdown(COLLECTION_HEADER, rows))
            parts.append(COLLECTION_NOTE.replace("\n", " ").rstrip())
    parts += _remarks(matrix, results, missing)
    return "\n\n".join(parts) + "\n"


def _remarks(matrix: Matrix, results: Mapping[str, Methods], missing: Sequence[str]) -> list[str]:
    everything = [result for methods in results.values() for runs in methods.values() for result in runs]
    shown = {name for methods in results.values() for name in methods}
    notes = {name: method.note for name, method in matrix.methods.items() if name in shown and method.note}
    remarks = [f"- `{name}`: {note}" for name, note in notes.items()]
    early = [f"{result.run.name} ({result.rounds_adopted})" for result in everything if result.rounds_adopted]
    if early:
        remarks.append(
            "- Interrupted runs whose student met collected rounds earlier than an uninterrupted one's (number of "
            f"rounds): {', '.join(early)}."
        )
    software = set[frozenset[str]]().union(*(result.made_with for result in everything))
    if len(software) > 1:
        common = frozenset.intersection(*software)
        kinds = sorted(", ".join(sorted(kind - common)) for kind in software)
        remarks.append(f"- **Not all was made with the same code: {'; '.join(kinds)}.**")
    if missing:
        remarks.append(f"- **Not finished: {', '.join(missing)}.**")
    return ["\n".join(remarks)] if remarks else []


def method_row(name: str, runs: Sequence[RunResult]) -> tuple[str, ...]:
    """A method's numbers, in the order of HEADER."""
    pooled = {
        which: [value for result in runs for value in result.finals[which].successes] for which in CHECKPOINTS
    }
    rewards = {
        which: [value for result in runs for value in result.finals[which].max_rewards]
        for which in CHECKPOINTS
    }
    episodes = counts(runs)
    per_seed = [f"{value / len(runs):.0f}" for value in episodes.values()]
    steps = {result.steps for result in runs} - {None}
    by_seed = [f"{np.mean(result.finals['last'].successes):.2f}" for result in runs]
    return (
        name,
        " / ".join(map(str, sorted(steps, key=str))) or "-",
        str(success_rate(pooled["best"])) if steps else "-",
        str(success_rate(pooled["last"])),
        " / ".join(by_seed) if len(by_seed) > 1 else "-",
        str(mean(rewards["best"])) if steps else "-",
        str(mean(rewards["last"])),
        str(len(pooled["last"])),
        " / ".join(per_seed) if episodes["generated"] else "-",
        training_time(runs) if steps else "-",
        f"{runs[0].latency.n_parameters / 1e6:.2f} M",
        f"{np.median([result.latency.median_ms for result in runs]):.1f}",
    )


def training_time(runs: Sequence[RunResult]) -> str:
    """Mean wall-clock per run, e.g. `310 s: teacher 20, environment 90, training 200`; the rest is training."""
    activities = {activity for result in runs for activity in result.seconds} - {"total"}
    spent = {
        activity: float(np.mean([result.seconds.get(activity, 0.0) for result in runs]))
        for activity in sorted(activities)
    }
    total = float(np.mean([result.seconds["total"] for result in runs]))
    parts = [f"{activity} {seconds:.0f}" for activity, seconds in spent.items()]
    if parts:
        parts.append(f"training {max(0.0, total - sum(spent.values())):.0f}")
    return f"{total:.0f} s" + (f": {', '.join(parts)}" if parts else "")


def difference_rows(methods: Methods, which: str, measure: str) -> list[tuple[str, ...]]:
    """Every method (row) minus every other (column)."""
    rows = []
    for name, runs in methods.items():
        cells = [
            "" if other == name else _cell(runs, others, which, measure) for other, others in methods.items()
        ]
        rows.append((name, *cells))
    return rows


def _cell(runs: Sequence[RunResult], others: Sequence[RunResult], which: str, measure: str) -> str:
    difference = compare(runs, others, which, measure)
    if difference is None:
        return "-"
    if difference.low == difference.high:  # no spread at all, which few environments may show by chance
        return f"{difference.mean:+.2f} (in every pair)"
    return f"**{difference}**" if difference.excludes_zero else str(difference)


def _words(measure: str) -> str:
    return {"success": "success rate", "max_reward": "mean max reward"}[measure]


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
