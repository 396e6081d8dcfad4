"""Evaluate a finished run: every checkpoint for the curve, the best and the last one on many more environments."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.envs import EnvConfig

from lerobot_agpd.analysis.evaluation import Checkpoint, Environments, Evaluation, checkpoint_steps
from lerobot_agpd.analysis.statistics import success_rate
from lerobot_agpd.comparison.files import read_json, write_json
from lerobot_agpd.comparison.matrix import MEASURES, EvaluationEntry, Matrix
from lerobot_agpd.comparison.provenance import digest, provenance
from lerobot_agpd.comparison.runs import Run, environment
from lerobot_agpd.comparison.training import progress, read_starts, train_command

logger = logging.getLogger(__name__)

EVALUATIONS = "evaluations"
RESULT = "run.json"


class Evaluator:
    """Evaluations of one run; each is stored when it is done, and made again if what was asked has changed.

    Args:
        run: the run.
        environments: its environments.
        entry: episodes and seeds.
    """

    def __init__(self, run: Run, environments: Environments, entry: EvaluationEntry):
        self.folder = run.folder / EVALUATIONS
        self.folder.mkdir(parents=True, exist_ok=True)
        self.environments = environments
        self.entry = entry

    def curve(self, label: str, path: str | Path) -> Evaluation:
        """A checkpoint on the environments that choose the best one."""
        return self._stored(f"curve-{label}", path, self.entry.curve_episodes, self.entry.curve_seed)

    def final(self, label: str, path: str | Path) -> Evaluation:
        """A checkpoint on the environments that nothing was chosen by."""
        return self._stored(f"final-{label}", path, self.entry.episodes, self.entry.seed)

    def _stored(self, name: str, path: str | Path, episodes: int, seed: int) -> Evaluation:
        file = self.folder / f"{name}.json"
        request = {
            "weights": digest(path),
            "env": draccus.encode(self.environments.config, EnvConfig),
            "episodes": episodes,
            "seed": seed,
            "batch_size": self.entry.batch_size,
            "device": self.entry.device,
        }
        known = read_evaluation(file, request)
        if known is not None:
            return known
        evaluation = Checkpoint(path, self.entry.device).evaluate(self.environments, episodes, seed)
        write_json(file, {"request": request, **asdict(evaluation)})
        logger.info("evaluated %s %s: success %s", path, name, success_rate(evaluation.successes))
        return evaluation


def read_evaluation(file: Path, request: Mapping[str, Any]) -> Evaluation | None:
    """A stored evaluation; None if it is missing, damaged, or answers another request."""
    if not file.is_file():
        return None
    try:
        content = read_json(file)
        if content.pop("request") != request:
            logger.warning("%s was made with other settings: evaluating again", file)
            return None
        evaluation = Evaluation(**content)
    except (ValueError, KeyError, TypeError) as error:
        logger.warning("evaluating again: %s", error)
        return None
    wanted = list(range(request["seed"], request["seed"] + request["episodes"]))
    lengths = {len(evaluation.successes), len(evaluation.max_rewards)}
    return evaluation if evaluation.seeds == wanted and lengths == {len(wanted)} else None


def best_step(curve: Mapping[int, Evaluation], measure: str) -> int:
    """The checkpoint with the highest mean of the measure.

    Ties, frequent with few episodes, go to the higher mean max reward, then to the later checkpoint.
    """

    def rank(step: int) -> tuple[float, float, int]:
        evaluation = curve[step]
        return (
            float(np.mean(getattr(evaluation, MEASURES[measure]))),
            float(np.mean(evaluation.max_rewards)),
            step,
        )

    return max(curve, key=rank)


def evaluate_run(matrix: Matrix, run: Run, rounds: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Evaluate what is missing of a run and write its result.

    Args:
        matrix: the comparison.
        run: a finished run, or a policy that is only evaluated.
        rounds: reports of its collection rounds.

    Returns:
        What was written: the content of `run.json`.

    Raises:
        ValueError: if the run's training is not finished.
    """
    task = matrix.tasks[run.task]
    result: dict[str, Any] = {
        "task": run.task,
        "method": run.method,
        "seed": run.seed,
        "measure": task.measure,
        "flags": dict(run.flags),
        "evaluation": asdict(matrix.evaluation),
    }
    with Environments(environment(task), matrix.evaluation.batch_size) as environments:
        evaluator = Evaluator(run, environments, matrix.evaluation)
        if run.policy:
            result |= _evaluate_policy(run, evaluator)
        else:
            result |= _evaluate_training(run, evaluator, task.measure)
    result["rounds"] = list(rounds)
    result["seconds"] = _seconds(run, rounds)
    result |= {"starts": read_starts(run), "evaluated_with": provenance()}
    write_json(run.folder / RESULT, result)
    return result


def _evaluate_policy(run: Run, evaluator: Evaluator) -> dict[str, Any]:
    final = asdict(evaluator.final("policy", run.policy))
    latency = Checkpoint(run.policy, evaluator.entry.device).latency()
    return {
        "policy": run.policy,
        "weights": digest(run.policy),
        "command": None,
        "config": None,
        "steps": None,
        "curve": {},
        "best": {"step": None, **final},
        "last": {"step": None, **final},
        "latency": asdict(latency),
    }


def _evaluate_training(run: Run, evaluator: Evaluator, measure: str) -> dict[str, Any]:
    reached = progress(run)
    if reached is None or not reached.finished:
        raise ValueError(f"{run.name} is not trained yet; run without --only=evaluate")
    paths = checkpoint_steps(run.output_dir)
    curve = {step: evaluator.curve(f"{step:06d}", path) for step, path in paths.items()}
    best, last = best_step(curve, measure), reached.step
    finals = {step: asdict(evaluator.final(f"{step:06d}", paths[step])) for step in {best, last}}
    starts = read_starts(run)
    return {
        "command": starts[0]["command"] if starts else train_command(run),
        "config": read_json(paths[last] / TRAIN_CONFIG_NAME),
        "steps": reached.steps,
        "curve": {step: asdict(evaluation) for step, evaluation in curve.items()},
        "best": {"step": best, **finals[best]},
        "last": {"step": last, **finals[last]},
        "latency": asdict(Checkpoint(paths[last], evaluator.entry.device).latency()),
    }


def _seconds(run: Run, rounds: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Wall-clock seconds of a run's training, and those of its rounds by activity."""
    split: dict[str, float] = {}
    for round_ in rounds:
        for activity, seconds in round_["seconds"].items():
            split[activity] = split.get(activity, 0.0) + seconds
    total = sum(start.get("seconds", 0.0) for start in read_starts(run))
    return {"total": total, **split}
