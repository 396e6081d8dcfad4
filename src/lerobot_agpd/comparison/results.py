"""Results of runs, read back from their JSON and checked against the matrix."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from lerobot_agpd.analysis.evaluation import Evaluation
from lerobot_agpd.analysis.latency import Latency
from lerobot_agpd.analysis.statistics import Difference, paired_difference
from lerobot_agpd.comparison.evaluations import RESULT
from lerobot_agpd.comparison.files import read_json
from lerobot_agpd.comparison.matrix import MEASURES, Matrix
from lerobot_agpd.comparison.runs import Run, expand

CHECKPOINTS = ("best", "last")


@dataclass(frozen=True)
class RunResult:
    """What one run reached.

    Attributes:
        run: the cell of the matrix.
        steps: gradient steps; None for a policy that is only evaluated.
        curve: training step to evaluation on the environments that choose the best.
        finals: `best` and `last` checkpoint on the environments of the final evaluation.
        final_steps: their training steps.
        latency: of one chunk.
        rounds: reports of the collection rounds.
        seconds: wall-clock by activity, and in total.
        rounds_adopted: rounds that an interrupted run's student met earlier than an uninterrupted one's.
        commits: of this project's code, in training and evaluation.
        packages: versions of the others, one set of texts for each start.
        inputs: fingerprints of what its training started from, by kind; empty for results older than the record.
        weights: digest of the weights of a policy that was only evaluated.
    """

    run: Run
    steps: int | None
    curve: Mapping[int, Evaluation]
    finals: Mapping[str, Evaluation]
    final_steps: Mapping[str, int | None]
    latency: Latency
    rounds: Sequence[Mapping[str, Any]]
    seconds: Mapping[str, float]
    rounds_adopted: int
    commits: frozenset[str]
    packages: frozenset[frozenset[str]]
    inputs: Mapping[str, str] = field(default_factory=dict)
    weights: str | None = None

    def values(self, which: str, measure: str) -> list[Any]:
        """A measure in every environment of the `best` or `last` checkpoint's final evaluation."""
        return list(getattr(self.finals[which], MEASURES[measure]))


def read_result(run: Run, matrix: Matrix) -> RunResult | None:
    """The result of a run; None if it has none yet.

    Raises:
        ValueError: if the file is damaged, or was made with other flags or evaluation settings.
    """
    path = run.folder / RESULT
    if not path.is_file():
        return None
    content = read_json(path)
    asked = {
        "flags": run.flags,
        "evaluation": asdict(matrix.evaluation),
        "measure": matrix.tasks[run.task].measure,
    }
    try:
        for key, wanted in asked.items():
            if content[key] != json.loads(json.dumps(wanted)):
                raise ValueError(
                    f"{path} was made with other {key} than the matrix has now; run the comparison again"
                )
        finals = {which: dict(content[which]) for which in CHECKPOINTS}
        software = (*content["starts"], content["evaluated_with"])
        return RunResult(
            run=run,
            steps=content["steps"],
            curve={int(step): Evaluation(**entry) for step, entry in content["curve"].items()},
            final_steps={which: entry.pop("step") for which, entry in finals.items()},
            finals={which: Evaluation(**entry) for which, entry in finals.items()},
            latency=Latency(**content["latency"]),
            rounds=content["rounds"],
            seconds=content["seconds"],
            rounds_adopted=sum(start["rounds_adopted"] for start in content["starts"]),
            commits=frozenset(_commit(entry["git"]) for entry in software),
            packages=frozenset(_packages(entry["versions"]) for entry in software),
            inputs=content["starts"][0].get("inputs", {}) if content["starts"] else {},
            weights=content.get("weights"),
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is damaged ({error!r}); remove it and run the comparison again: finished parts are kept"
        ) from error


def _commit(git: Mapping[str, Any] | None) -> str:
    return f"{git['commit'][:9]}{' (modified)' if git['modified'] else ''}" if git else "no checkout"


def _packages(versions: Mapping[str, str]) -> frozenset[str]:
    return frozenset(f"{name} {number}" for name, number in versions.items())


def read_results(
    matrix: Matrix, read: Callable[[Run, Matrix], RunResult | None] = read_result
) -> tuple[dict[str, dict[str, list[RunResult]]], list[str]]:
    """Results of a matrix by task and method, in its order, and the names of runs that have none.

    Methods that were never begun on a task are not named: they are no part of the report.

    Raises:
        ValueError: as `read` does.
    """
    found: dict[str, dict[str, list[RunResult]]] = {}
    missing = []
    for run in expand(matrix):
        result = read(run, matrix)
        if result is not None:
            found.setdefault(run.task, {}).setdefault(run.method, []).append(result)
        elif run.folder.parent.exists():
            missing.append(run.name)
    order = list(matrix.methods)
    return {
        task: {name: methods[name] for name in order if name in methods} for task, methods in found.items()
    }, missing


def outcomes(results: Sequence[RunResult], which: str, measure: str) -> dict[int | None, list[float]]:
    """Training seed to the outcome in every environment of the final evaluation."""
    return {result.run.seed: [float(value) for value in result.values(which, measure)] for result in results}


def compare(
    first: Sequence[RunResult], second: Sequence[RunResult], which: str, measure: str
) -> Difference | None:
    """Paired difference of two methods over the training seeds that both have; None without a common one.

    A policy that was only evaluated has no training seed and is paired with every seed of the other.
    """
    a, b = outcomes(first, which, measure), outcomes(second, which, measure)
    seeds = (
        [seed for seed in a if seed in b] if None not in a and None not in b else [*a] if None in b else [*b]
    )
    rows = [(a.get(seed, a.get(None)), b.get(seed, b.get(None))) for seed in seeds]
    if not rows:
        return None
    return paired_difference(np.array([row[0] for row in rows]), np.array([row[1] for row in rows]))


def counts(results: Sequence[RunResult]) -> dict[str, int]:
    """Generated, successful and kept episodes of a method, summed over its training seeds."""
    keys = ("generated", "successful", "kept")
    return {key: sum(round_[key] for result in results for round_ in result.rounds) for key in keys}
