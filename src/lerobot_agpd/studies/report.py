"""Reports in markdown: some runs side by side, or a whole comparison with the notes that its tables need."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_agpd.files import write_json, write_text
from lerobot_agpd.studies.matrix import LABELS, Matrix
from lerobot_agpd.studies.results import Methods, Result, RunResult
from lerobot_agpd.studies.tables import (
    collection_table,
    cost_table,
    difference_table,
    markdown,
    outcome_table,
    results_table,
    summary_table,
    ways_table,
)

SAME = ("packages", "teacher", "demonstrations")
"""What all runs of a task should have been made with, beside the code."""

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

COLLECTION_NOTE = """\
Collection, means over rounds and training seeds; success pools their episodes. It is that of the filter, which wants success
at the last step (or a reward) and leaves out starts that are solved already, so it is lower than in the evaluations. In the
teacher-only part of every round the teacher acts alone, with `rollin` after the student's part. Distances are between executed
chunks, root mean square in the teacher's units, with teacher and strategy sampled from the same noise; the spread is the
standard deviation of the teacher's own samples at one observation (older rounds lack it); the KL divergence is that of
moment-matched Gaussians over single actions (Eq. 14), in nats, the median over observations. Entropy (nearest neighbors,
nats) and held-out coverage (P_S) are those of kept states, in standard deviations of the demonstrations.
"""

WAYS_NOTE = """\
Kept episodes on every way, per training seed and round, and in brackets their entropy over the ways in nats: 0 if all took
the same.
"""


def write_summary(results: Sequence[Result], environment: Mapping[str, Any], seed: int, folder: Path) -> None:
    """Write report.md and report.json of some results.

    Args:
        results: rows of the table.
        environment: fields of the environment they were evaluated in.
        seed: first environment seed.
        folder: where to.
    """
    content = {
        "environment": environment,
        "first_seed": seed,
        "methods": [result.to_json() for result in results],
    }
    write_json(folder / "report.json", content)
    write_text(folder / "report.md", markdown(summary_table(results)) + "\n")


def comparison_report(
    matrix: Matrix, results: Mapping[str, Methods], missing: Sequence[str], pictures: str = ""
) -> str:
    """The whole report of a comparison; its pictures lie in `pictures`, e.g. `../figures/`."""
    parts = _methods(matrix, results)
    for task, methods in results.items():
        parts.append(f"## {matrix.tasks[task].title or task}")
        parts += _task(matrix, task, methods, pictures)
    parts += _notes(matrix, results)
    parts += _remarks(results, missing)
    return "\n\n".join(parts) + "\n"


def _methods(matrix: Matrix, results: Mapping[str, Methods]) -> list[str]:
    shown = {name for methods in results.values() for name in methods}
    notes = [
        f"- `{name}`: {method.note}"
        for name, method in matrix.methods.items()
        if name in shown and method.note
    ]
    return ["## Methods", "\n".join(notes)] if notes else []


def _task(matrix: Matrix, task: str, methods: Methods, pictures: str) -> list[str]:
    """One picture and one table, and everything else in folds."""
    measure = matrix.tasks[task].measure
    references = [name for name in matrix.references or methods if name in methods]
    reference = next((name for name in ("pd", *references) if name in methods and len(methods) > 1), None)
    parts = [
        f"![outcomes]({pictures}outcomes-{task}.png)",
        markdown(outcome_table(methods, measure, reference)),
    ]
    everything = [markdown(results_table(methods, measure, len(matrix.seeds)))]
    if len(methods) > 1 and references:
        everything.append(f"Paired differences in {LABELS[measure]}, last checkpoint (row minus column):")
        everything.append(markdown(difference_table(methods, references, "last", measure)))
    parts.append(_fold("All checkpoints, measures and paired differences", everything))
    parts.append(_fold("Learning curves", [f"![learning curves]({pictures}curves-{task}.png)"]))
    parts.append(_fold("What it took", [markdown(cost_table(methods))]))
    if rows := collection_table(methods):
        parts.append(_fold("What the rounds did", [markdown(rows)]))
    if rows := ways_table(methods):
        note = WAYS_NOTE.replace("\n", " ").rstrip()
        parts.append(_fold("Which way the kept episodes took", [note, markdown(rows)]))
    return parts


def _fold(title: str, parts: Sequence[str]) -> str:
    """Markdown that a reader opens; GitHub and the documentation's site both know it."""
    content = "\n\n".join(parts)
    return f'<details markdown="1">\n<summary>{title}</summary>\n\n{content}\n\n</details>'


def _notes(matrix: Matrix, results: Mapping[str, Methods]) -> list[str]:
    entry = matrix.evaluation
    notes = NOTES.format(
        measure=" or ".join(dict.fromkeys(LABELS[matrix.tasks[task].measure] for task in results)),
        curve_episodes=entry.curve_episodes,
        curve_seed=entry.curve_seed,
        episodes=entry.episodes,
        seed=entry.seed,
    )
    collected = any(collection_table(methods) for methods in results.values())
    paragraphs = [*notes.split("\n\n"), *([COLLECTION_NOTE] if collected else [])]
    return ["## Reading the tables", *(paragraph.replace("\n", " ").rstrip() for paragraph in paragraphs)]


# ---- what disturbs the comparison ----


def _remarks(results: Mapping[str, Methods], missing: Sequence[str]) -> list[str]:
    everything = {
        task: [run for runs in methods.values() for run in runs] for task, methods in results.items()
    }
    remarks = []
    runs = [run for task in everything.values() for run in task]
    if early := [f"{run.name} ({run.rounds_adopted})" for run in runs if run.rounds_adopted]:
        remarks.append(
            "- Interrupted runs whose student met collected rounds earlier than an uninterrupted one's (number of "
            f"rounds): {', '.join(early)}."
        )
    if len(states := frozenset[str]().union(*(run.made_with["code"] for run in runs))) > 1:
        remarks.append(
            f"- The code went through {len(states)} states meanwhile; each `run.json` names its own."
        )
    remarks += [
        remark
        for task, its_runs in everything.items()
        for kind in SAME
        for remark in _unlike(task, its_runs, kind)
    ]
    if missing:
        remarks.append(f"- **Not finished: {_by_seeds(missing)}.**")
    return ["\n".join(remarks)] if remarks else []


def _unlike(task: str, runs: Sequence[RunResult], kind: str) -> Iterator[str]:
    """A remark if a task's runs were not all made with the same: a teacher trained again is another teacher."""
    groups: dict[str, list[str]] = {}
    for run in runs:
        for fingerprint in run.made_with.get(kind, ()):
            groups.setdefault(fingerprint, []).append(run.name)
    if len(groups) > 1:
        named = " / ".join(_by_seeds(names) for names in groups.values())
        yield f"- **Not all of {task} was made with the same {kind}: {named}.**"


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
