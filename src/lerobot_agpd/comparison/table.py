"""The comparison in words: the methods; per task what they reached, how they differ, what they took and collected."""

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

COST_HEADER = ("", "episodes generated / successful / kept", "training time", "parameters")

RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")

NOTES = """\
Success counts at any step of an episode, as LeRobot evaluates; starts that are solved already count too, for every
method alike. `last` is the checkpoint after the last gradient step, `best` the one with the highest {measure} over
{curve_episodes} environments (seeds from {curve_seed}), as in the paper's appendix C: few, so that it is often no better. Both
are evaluated on the same {episodes} other environments (seeds from {seed}), which neither training, collection nor the
choice of the checkpoint used. Intervals of single methods pool all training seeds (Wilson, Student's t; 95 %), treat
episodes as independent and therefore say nothing about another training seed. A mean max reward that is
success but for a constant is left out.

Compare methods by the paired differences: row minus column, over the training seeds that both have (the raised number says
how many) and the same environments, with a 95 % t interval for training seeds and environments as crossed random factors
(Satterthwaite's degrees of freedom). Bold: two or more seeds, and the interval excludes zero. With one seed the
interval covers environments only; two trainings of one and the same method can differ by more. With three the factor is
up to 4.3, so small differences are not told apart. Nothing is adjusted for the number of comparisons.

Pictures: a thick bar spans a method's training seeds (small dots), a thin one is the interval over the episodes of a
single seed. Learning curves show {curve_episodes} environments per checkpoint, the range over training seeds shaded, and a
triangle at the highest point; a dashed line is a policy's final evaluation, on other environments.

Episodes and times are means per training seed; times were taken on a machine that may have run other jobs beside.
"""


def report(matrix: Matrix, results: Mapping[str, Methods], missing: Sequence[str], pictures: str = "") -> str:
    """The whole report in markdown; its pictures (`write_pictures`) lie in `pictures`, e.g. `../figures/`."""
    parts = _methods(matrix, results)
    for task, methods in results.items():
        parts.append(f"## {matrix.tasks[task].title or task}")
        parts += _task(matrix, task, methods, pictures)
    parts += _notes(matrix, results)
    parts += _remarks(results, missing)
    return "\n\n".join(parts) + "\n"


def _task(matrix: Matrix, task: str, methods: Methods, pictures: str) -> list[str]:
    measure = matrix.tasks[task].measure
    parts = [
        f"![outcomes]({pictures}outcomes-{task}.png)",
        _markdown(*results_table(methods, measure, len(matrix.seeds))),
    ]
    references = [name for name in matrix.references or methods if name in methods]
    if len(methods) > 1 and references:
        parts.append(f"Paired differences in {LABELS[measure]}, last checkpoint (row minus column):")
        parts.append(_markdown(("", *references), difference_rows(methods, references, "last", measure)))
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
    commits = set[str]().union(*(result.commits for result in everything))
    if len(commits) > 1:
        remarks.append(
            f"- The code went through {len(commits)} states meanwhile; each `run.json` names its own."
        )
    packages = set[frozenset[str]]().union(*(result.packages for result in everything))
    if len(packages) > 1:
        common = frozenset.intersection(*packages)
        kinds = sorted(", ".join(sorted(kind - common)) for kind in packages)
        remarks.append(f"- **Not all was made with the same packages: {'; '.join(kinds)}.**")
    remarks += [remark for task, methods in results.items() for remark in _other_inputs(task, methods)]
    if missing:
        remarks.append(f"- **Not finished: {_by_seeds(missing)}.**")
    return ["\n".join(remarks)] if remarks else []


def _other_inputs(task: str, methods: Methods) -> list[str]:
    """Remarks on a task's runs that did not start from the same files: a teacher trained again is another teacher."""
    runs = [result for entries in methods.values() for result in entries]
    teachers = {result.run.flags.get("policy.teacher.path") for result in runs}
    evaluated = {result.weights for result in runs if result.run.policy in teachers and result.weights}
    remarks = []
    for kind in ("teacher", "demonstrations"):
        by_file: dict[str, list[str]] = {}
        for result in runs:
            if fingerprint := result.inputs.get(kind):
                by_file.setdefault(fingerprint, []).append(result.run.name)
        known = by_file.keys() | (evaluated if kind == "teacher" else set())
        if len(known) > 1:
            groups = "; ".join(f"{file[:9]}: {_by_seeds(names)}" for file, names in sorted(by_file.items()))
            remarks.append(
                f"- **Not all of {task} had the same {kind}; those recorded, by fingerprint: {groups}.**"
            )
    return remarks


def _by_seeds(runs: Sequence[str]) -> str:
    """E.g. `seed-1, seed-2 of pusht/bc, pusht/pd; seed-2 of pusht/agpd`."""
    seeds: dict[str, list[str]] = {}
    for name in runs:
        method, _, seed = name.rpartition("/")
        seeds.setdefault(method, []).append(seed)
    methods: dict[str, list[str]] = {}
    for method, which in seeds.items():
        methods.setdefault(", ".join(which), []).append(method)
    return "; ".join(f"{which} of {', '.join(names)}" for which, names in methods.items())


def results_table(
    methods: Methods, measure: str, n_seeds: int
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Header and rows of what the methods reached: the task's measure first, then the other if it adds anything.

    Args:
        methods: a task's results.
        measure: what the task is judged by.
        n_seeds: training seeds that the comparison is to have.
    """
    others = [kind for kind in LABELS if kind != measure and (kind == "success" or _reward_adds(methods))]
    header = ["", "training seeds", "gradient steps", f"{LABELS[measure]}, last", "by seed"]
    header += [f"{LABELS[measure]}, best"]
    header += [f"{LABELS[kind]}, {which}" for kind in others for which in reversed(CHECKPOINTS)]
    rows = []
    for name, runs in methods.items():
        trained = runs[0].steps is not None
        by_seed = [f"{pooled([result], 'last', measure).mean:.2f}" for result in runs]
        cells = [
            name,
            f"{len(runs)} of {n_seeds}" if trained else "-",
            str(runs[0].steps) if trained else "-",
            str(pooled(runs, "last", measure)),
            " / ".join(by_seed) if len(runs) > 1 else "-",
            str(pooled(runs, "best", measure)) if trained else "-",
        ]
        for kind in others:
            cells += [str(pooled(runs, "last", kind)), str(pooled(runs, "best", kind)) if trained else "-"]
        rows.append(tuple(cells))
    return tuple(header), rows


def _reward_adds(methods: Methods) -> bool:
    """Whether the max rewards of the evaluations are more than success and a constant."""
    finals = [result.finals[which] for runs in methods.values() for result in runs for which in CHECKPOINTS]
    constants = [np.subtract(final.max_rewards, np.asarray(final.successes, float)) for final in finals]
    return bool(np.ptp(np.concatenate(constants)) > 1e-6)


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
            *(
                "" if other == name else difference_cell(runs, methods[other], which, measure)
                for other in references
            ),
        )
        for name, runs in methods.items()
    ]


def difference_cell(runs: Sequence[RunResult], others: Sequence[RunResult], which: str, measure: str) -> str:
    """E.g. `**+0.05 [+0.01, +0.09]**³`: bold if it excludes zero with several training seeds, their number raised."""
    difference = compare(runs, others, which, measure) if runs and others else None
    if difference is None:
        return "-"
    seeds = raised(difference.n_seeds)
    if difference.low == difference.high:  # no spread at all, which few environments may show by chance
        return f"{difference.mean:+.2f}{seeds} (in every pair)"
    bold = difference.excludes_zero and difference.n_seeds > 1
    return f"**{difference}**{seeds}" if bold else f"{difference}{seeds}"


def raised(number: int) -> str:
    """A number of training seeds as table cells show it."""
    return str(number).translate(RAISED)


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
