"""Evaluate the runs of a comparison into `run.json`, and read them back, checked against the matrix."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from lerobot.configs.train import TRAIN_CONFIG_NAME

from lerobot_agpd.files import read_json, write_json
from lerobot_agpd.rollout.report import RoundReport
from lerobot_agpd.studies.evaluation import (
    Environments,
    Evaluation,
    Evaluator,
    best_step,
    checkpoint_steps,
)
from lerobot_agpd.studies.latency import Latency
from lerobot_agpd.studies.matrix import Matrix
from lerobot_agpd.studies.parsing import decode_environment
from lerobot_agpd.studies.provenance import digest, provenance
from lerobot_agpd.studies.results import CHECKPOINTS, RunResult
from lerobot_agpd.studies.runs import Run, expand
from lerobot_agpd.studies.training import progress, read_starts, train_command

RESULT = "run.json"


def evaluate_run(matrix: Matrix, run: Run, rounds: Sequence[RoundReport]) -> None:
    """Evaluate what is missing of a finished run, or of a policy that is only evaluated, and write `run.json`.

    Args:
        matrix: the comparison.
        run: one of its runs.
        rounds: reports of its collection rounds.

    Raises:
        ValueError: if the run's training is not finished.
    """
    task, settings = matrix.tasks[run.task], matrix.evaluation
    with Environments(decode_environment(task.env), settings.batch_size) as environments:
        evaluator = Evaluator(environments, run.folder, settings.device)
        parts = _evaluate_policy if run.policy else _evaluate_training
        measured = parts(matrix, run, evaluator)
    content = {
        "task": run.task,
        "method": run.method,
        "seed": run.seed,
        **_requested(matrix, run),
        **measured,
        "rounds": [report.to_json() for report in rounds],
        "seconds": _seconds(run, rounds),
        "starts": read_starts(run),
        "evaluated_with": provenance(),
    }
    write_json(run.folder / RESULT, content)


def _requested(matrix: Matrix, run: Run) -> dict[str, Any]:
    """What a result depends on."""
    return {
        "measure": matrix.tasks[run.task].measure,
        "flags": dict(run.flags),
        "evaluation": asdict(matrix.evaluation),
    }


def _evaluate_policy(matrix: Matrix, run: Run, evaluator: Evaluator) -> dict[str, Any]:
    final = evaluator.evaluate(run.policy, matrix.evaluation.episodes, matrix.evaluation.seed)
    return {
        "policy": run.policy,
        "weights": digest(run.policy),
        "steps": None,
        "curve": {},
        **{which: {"step": None, **asdict(final)} for which in CHECKPOINTS},
        "latency": asdict(evaluator.latency(run.policy)),
    }


def _evaluate_training(matrix: Matrix, run: Run, evaluator: Evaluator) -> dict[str, Any]:
    settings, trained = matrix.evaluation, progress(run)
    if trained is None or not trained.finished:
        raise ValueError(f"{run.name} is not trained yet; run without --only=evaluate")
    paths = checkpoint_steps(run.output_dir)
    curve = {
        step: evaluator.evaluate(path, settings.curve_episodes, settings.curve_seed)
        for step, path in paths.items()
    }
    chosen = {"best": best_step(curve, matrix.tasks[run.task].measure), "last": trained.step}
    finals = {
        which: {"step": step, **asdict(evaluator.evaluate(paths[step], settings.episodes, settings.seed))}
        for which, step in chosen.items()
    }
    last, starts = paths[trained.step], read_starts(run)
    return {
        "command": starts[0]["command"] if starts else train_command(run),
        "config": read_json(last / TRAIN_CONFIG_NAME),
        "steps": trained.steps,
        "curve": {step: asdict(evaluation) for step, evaluation in curve.items()},
        **finals,
        "latency": asdict(evaluator.latency(last)),
    }


def _seconds(run: Run, rounds: Sequence[RoundReport]) -> dict[str, float]:
    """Wall-clock seconds of a run's training, and those of its rounds by activity."""
    seconds = {"total": sum(start.get("seconds", 0.0) for start in read_starts(run))}
    for report in rounds:
        for activity, spent in report.seconds.items():
            seconds[activity] = seconds.get(activity, 0.0) + spent
    return seconds


def read_result(
    run: Run,
    matrix: Matrix,
    translate: Callable[[dict[str, Any]], dict[str, Any]] = lambda content: content,
) -> RunResult | None:
    """Read the result of a run; None if it has none yet.

    Args:
        run: the run.
        matrix: its comparison.
        translate: applied to the JSON before it is checked.

    Raises:
        ValueError: if the file is damaged, or was made with other flags or evaluation settings.
    """
    path = run.folder / RESULT
    if not path.is_file():
        return None
    content = translate(read_json(path))
    try:
        for key, requested in _requested(matrix, run).items():
            if content[key] != json.loads(json.dumps(requested)):
                raise ValueError(
                    f"{path} was made with other {key} than the matrix has now; run the comparison again"
                )
        return _result(run, content)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is damaged ({error!r}); remove it and run the comparison again: finished parts are kept"
        ) from error


def _result(run: Run, content: Mapping[str, Any]) -> RunResult:
    software = (*content["starts"], content["evaluated_with"])
    return RunResult(
        name=run.name,
        run=run,
        steps=content["steps"],
        curve={int(step): _evaluation(entry) for step, entry in content["curve"].items()},
        finals={which: _evaluation(content[which]) for which in CHECKPOINTS},
        latency=Latency(**content["latency"]),
        rounds=[RoundReport.from_json(entry) for entry in content["rounds"]],
        seconds=content["seconds"],
        rounds_adopted=sum(start["rounds_adopted"] for start in content["starts"]),
        commits=frozenset(_commit(entry["git"]) for entry in software),
        packages=frozenset(_packages(entry["versions"]) for entry in software),
        inputs=content["starts"][0].get("inputs", {}) if content["starts"] else {},
        weights=content.get("weights"),
    )


def _evaluation(entry: Mapping[str, Any]) -> Evaluation:
    return Evaluation(**{key: value for key, value in entry.items() if key != "step"})


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
    results: dict[str, dict[str, list[RunResult]]] = {}
    missing = []
    for run in expand(matrix):
        result = read(run, matrix)
        if result is not None:
            results.setdefault(run.task, {}).setdefault(run.method, []).append(result)
        elif run.folder.parent.exists():
            missing.append(run.name)
    return {
        task: {name: methods[name] for name in matrix.methods if name in methods}
        for task, methods in results.items()
    }, missing
