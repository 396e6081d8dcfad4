"""Evaluate the runs of a comparison into `run.json`, and read them back, checked against the matrix."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from typing import Any

from lerobot.configs.train import TRAIN_CONFIG_NAME

from lerobot_agpd.files import read_json, write_json
from lerobot_agpd.flag_checks import require
from lerobot_agpd.rollout.report import RoundReport, read_reports
from lerobot_agpd.studies.evaluation import Evaluation, Evaluator, best_step, checkpoint_steps
from lerobot_agpd.studies.latency import Latency
from lerobot_agpd.studies.matrix import Matrix
from lerobot_agpd.studies.parsing import decode_environment
from lerobot_agpd.studies.provenance import digest, provenance
from lerobot_agpd.studies.results import CHECKPOINTS, RunResult
from lerobot_agpd.studies.runs import Run, expand
from lerobot_agpd.studies.training import is_trained, read_starts, replay_folder, train_command
from lerobot_agpd.studies.ways import read_ways, ways_of_rounds

logger = logging.getLogger(__name__)

RESULT = "run.json"


def evaluate_run(matrix: Matrix, run: Run) -> None:
    """Evaluate what is missing of a finished run, or of a policy that is only evaluated, and write `run.json`.

    Raises:
        FlagError: if the run's training is not finished.
    """
    env_config, settings = decode_environment(matrix.tasks[run.task].env), matrix.evaluation
    with closing(Evaluator(env_config, settings.batch_size, run.folder, settings.device)) as evaluator:
        measured = (_evaluate_policy if run.policy else _evaluate_training)(matrix, run, evaluator)
    rounds = read_reports(replay_folder(run))
    content = {
        "task": run.task,
        "method": run.method,
        "seed": run.seed,
        **_requested(matrix, run),
        **measured,
        "rounds": [report.to_json() for report in rounds],
        "ways": [entry.to_json() for entry in ways_of_rounds(replay_folder(run), env_config)],
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
    settings = matrix.evaluation
    require(is_trained(run), f"{run.name} is not trained yet; run without --only=evaluate")
    paths = checkpoint_steps(run.output_dir)
    curve = {
        step: evaluator.evaluate(path, settings.curve_episodes, settings.curve_seed)
        for step, path in paths.items()
    }
    last = max(paths)
    chosen = {"best": best_step(curve, matrix.tasks[run.task].measure), "last": last}
    finals = {
        which: {"step": step, **asdict(evaluator.evaluate(paths[step], settings.episodes, settings.seed))}
        for which, step in chosen.items()
    }
    starts = read_starts(run)
    return {
        "command": starts[0]["command"] if starts else train_command(run),
        "config": read_json(paths[last] / TRAIN_CONFIG_NAME),
        "steps": last,
        "curve": {step: asdict(evaluation) for step, evaluation in curve.items()},
        **finals,
        "latency": asdict(evaluator.latency(paths[last])),
    }


def _seconds(run: Run, rounds: Sequence[RoundReport]) -> dict[str, float]:
    """Wall-clock seconds of a run's training, and those of its rounds by activity."""
    seconds = {"total": sum(start.get("seconds", 0.0) for start in read_starts(run))}
    for report in rounds:
        for activity, spent in report.seconds.items():
            seconds[activity] = seconds.get(activity, 0.0) + spent
    return seconds


Translate = Callable[[dict[str, Any]], dict[str, Any]]
"""Applied to the JSON of a result before it is checked."""


def read_result(run: Run, matrix: Matrix, translate: Translate = lambda content: content) -> RunResult | None:
    """Read the result of a run of a matrix; None if it has none yet.

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
        return _result(run, matrix, content)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is damaged ({error!r}); remove it and run the comparison again: finished parts are kept"
        ) from error


def _result(run: Run, matrix: Matrix, content: Mapping[str, Any]) -> RunResult:
    return RunResult(
        name=run.name,
        run=run,
        steps=content["steps"],
        curve={int(step): _evaluation(entry) for step, entry in content["curve"].items()},
        finals={which: _evaluation(content[which]) for which in CHECKPOINTS},
        latency=Latency(**content["latency"]),
        rounds=[RoundReport.from_json(entry) for entry in content["rounds"]],
        ways=read_ways(content.get("ways", [])),
        seconds=content["seconds"],
        rounds_adopted=sum(start.get("rounds_adopted", 0) for start in content["starts"]),
        made_with=_made_with(run, matrix, content),
        weights=content.get("weights"),
    )


def _made_with(run: Run, matrix: Matrix, content: Mapping[str, Any]) -> dict[str, frozenset[str]]:
    """What runs of a comparison should have in common, by kind."""
    software = (*content["starts"], content["evaluated_with"])
    files = dict(content["starts"][0].get("inputs", {})) if content["starts"] else {}
    if run.policy == matrix.tasks[run.task].teacher and content.get("weights"):
        files["teacher"] = content["weights"]
    return {
        "code": frozenset(str(entry["git"]) for entry in software),
        "packages": frozenset(json.dumps(entry["versions"], sort_keys=True) for entry in software),
        **{kind: frozenset([fingerprint]) for kind, fingerprint in files.items()},
    }


def _evaluation(entry: Mapping[str, Any]) -> Evaluation:
    return Evaluation(**{key: value for key, value in entry.items() if key != "step"})


def read_results(
    matrix: Matrix, translate: Translate = lambda content: content
) -> tuple[dict[str, dict[str, list[RunResult]]], list[str]]:
    """Results of a matrix by task and method, in its order, and the names of runs that have none.

    A damaged or outdated result counts as missing. Methods that were never begun on a task are not named: they are
    no part of the report.
    """
    results: dict[str, dict[str, list[RunResult]]] = {}
    missing = []
    for run in expand(matrix):
        try:
            result = read_result(run, matrix, translate)
        except ValueError as error:
            logger.warning("left out of the report: %s", error)
            result = None
        if result is not None:
            results.setdefault(run.task, {}).setdefault(run.method, []).append(result)
        elif run.folder.parent.exists():
            missing.append(run.name)
    return {
        task: {name: methods[name] for name in matrix.methods if name in methods}
        for task, methods in results.items()
    }, missing
