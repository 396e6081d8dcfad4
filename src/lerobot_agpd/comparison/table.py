"""The comparison in words. Per task: results of the methods, paired differences, costs, what the rounds did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lerobot_agpd.comparison.matrix import LABELS, Matrix
from lerobot_agpd.comparison.outcomes import pooled
from lerobot_agpd.comparison.results import CHECKPOINTS, RunResult, compare, counts
from lerobot_agpd.comparison.rounds import (
    HEADER as COLLECTION_HEADER,
    NOTE as COLLECTION_NOTE,
    collection_rows,
)

Methods = Mapping[str, Sequence[RunResult]]
"""Method to its results, one per training seed."""

RESULT_HEADER = (
    "",
    "gradient steps",
    "success, last",
    "success, best",
    "by seed, last",
    "mean max reward, last",
    "mean max reward, best",
    "N",
)

COST_HEADER = (
    "",
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
seeds at all. Bold: the interval excludes zero. Nothing is adjusted for the number of comparisons.

Pictures: `outcomes` shows mean and interval over all episodes, and a small dot for every training seed; the grey band is
the interval of a policy that was only evaluated. `curves` shows {curve_episodes} environments per checkpoint, the range
over training seeds shaded, and a triangle at the highest point.

Episodes and times are means per training seed; times were taken on a machine that may have run other jobs beside.
"""


def report(matrix: Matrix, results: Mapping[str, Methods], missing: Sequence[str], pictures: str = "") -> str:
    """The whole report in markdown; its pictures (`write_pictures`) lie in `pictures`, e.g. `../figures/`."""
    parts = []
    for task, methods in results.items():
        parts.append(f"## {matrix.tasks[task].title or task}")
        parts += _task(matrix, task, methods, pictures)
    parts += _methods(matrix, results)
    parts += _notes(matrix, results)
    parts += _remarks(results, missing)
    return "\n\n".join(parts) + "\n"


def _task(matrix: Matrix, task: str, methods: Methods, pictures: str) -> list[str]:
    measure = matrix.tasks[task].measure
    parts = [
        f"![outcomes]({pictures}outcomes-{task}.png)",
        _markdown(RESULT_HEADER, [result_row(name, runs, measure) for name, runs in methods.items()]),
    ]
    references = [name for name in matrix.references or methods if name in methods]
    for which in reversed(CHECKPOINTS) if len(methods) > 1 and references else ():
        parts.append(f"Paired differences in {LABELS[measure]}, {which} checkpoint (row minus column):")
        parts.append(_markdown(("", *references), difference_rows(methods, references, which, measure)))
    parts.append(f"![learning curves]({pictures}curves-{task}.png)")
    parts.append("### What it took")
    parts.append(_markdown(COST_HEADER, [cost_row(name, runs) for name, runs in methods.items()]))
    if rows := collection_rows(methods):
        parts += ["### What the rounds did", _markdown(COLLECTION_HEADER, rows)]
    return parts


def _methods(matrix: Matrix, results: Mapping[str, Methods]) -> list[str]:
    shown = {name for methods in results.values() for name in methods}
    notes = [
        f"- `{name}`: {method.note}"
        for name, method in matrix.methods.items()
        if name in shown and method.note
    ]
    return ["## Methods", "\n".join(notes)] if notes else []


def _notes(matrix: Matrix, results: Mapping[str, Methods]) -> list[str]:
    entry = matrix.evaluation
    notes = NOTES.format(
        measure=" or ".join(dict.fromkeys(LABELS[matrix.tasks[task].measure] for task in results)),
        curve_episodes=entry.curve_episodes,
        curve_seed=entry.curve_seed,
        episodes=entry.episodes,
        seed=entry.seed,
    )
    collected = any(collection_rows(methods) for methods in results.values())
    paragraphs = [*notes.split("\n\n"), *([COLLECTION_NOTE] if collected else [])]
    return ["## Reading the tables", *(paragraph.replace("\n", " ").rstrip() for paragraph in paragraphs)]


def _remarks(results: Mapping[str, Methods], missing: Sequence[str]) -> list[str]:
    everything = [result for methods in results.values() for runs in methods.values() for result in runs]
    remarks = []
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


def result_row(name: str, runs: Sequence[RunResult], measure: str) -> tuple[str, ...]:
    """What a method reached, in the order of RESULT_HEADER; seed by seed, the task's own measure."""
    steps = {result.steps for result in runs} - {None}
    success, reward = (
        {which: pooled(runs, which, kind) for which in CHECKPOINTS} for kind in ("success", "max_reward")
    )
    by_seed = [f"{pooled([result], 'last', measure).mean:.2f}" for result in runs]
    return (
        name,
        " / ".join(map(str, sorted(steps, key=str))) or "-",
        str(success["last"]),
        str(success["best"]) if steps else "-",
        " / ".join(by_seed) if len(by_seed) > 1 else "-",
        str(reward["last"]),
        str(reward["best"]) if steps else "-",
        str(success["last"].n),
    )


def cost_row(name: str, runs: Sequence[RunResult]) -> tuple[str, ...]:
    """What it took, in the order of COST_HEADER."""
    episodes = counts(runs)
    per_seed = [f"{value / len(runs):.0f}" for value in episodes.values()]
    trained = any(result.steps is not None for result in runs)
    return (
        name,
        " / ".join(per_seed) if episodes["generated"] else "-",
        training_time(runs) if trained else "-",
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


def difference_rows(
    methods: Methods, references: Sequence[str], which: str, measure: str
) -> list[tuple[str, ...]]:
    """Every method (row) minus every reference (column)."""
    return [
        (
            name,
            *("" if other == name else _cell(runs, methods[other], which, measure) for other in references),
        )
        for name, runs in methods.items()
    ]


def _cell(runs: Sequence[RunResult], others: Sequence[RunResult], which: str, measure: str) -> str:
    difference = compare(runs, others, which, measure)
    if difference is None:
        return "-"
    if difference.low == difference.high:  # no spread at all, which few environments may show by chance
        return f"{difference.mean:+.2f} (in every pair)"
    return f"**{difference}**" if difference.excludes_zero else str(difference)


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
