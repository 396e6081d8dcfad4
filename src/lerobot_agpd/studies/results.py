"""What policies achieved, as the tables and pictures of every command read it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from lerobot_agpd.rollout.report import RoundReport
from lerobot_agpd.studies.evaluation import Evaluation
from lerobot_agpd.studies.latency import Latency
from lerobot_agpd.studies.runs import Run
from lerobot_agpd.studies.statistics import Difference, Estimate, mean, paired_difference, success_rate
from lerobot_agpd.studies.ways import RoundWays

CHECKPOINTS = ("best", "last")


@dataclass(frozen=True, kw_only=True)
class Result:
    """What one policy achieved.

    Attributes:
        name: as shown.
        finals: final evaluation of the `last` checkpoint and, in a comparison, of the `best` one.
        latency: of one chunk.
        curve: training step to evaluation; empty for a policy that is only evaluated.
        rounds: reports of the collection rounds.
    """

    name: str
    finals: Mapping[str, Evaluation]
    latency: Latency
    curve: Mapping[int, Evaluation] = field(default_factory=dict)
    rounds: Sequence[RoundReport] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain values, with the intervals of the last checkpoint spelled out."""
        last = self.finals["last"]
        return {
            "name": self.name,
            "final": asdict(last),
            "latency": asdict(self.latency),
            "curve": {step: asdict(evaluation) for step, evaluation in self.curve.items()},
            "rounds": [report.to_json() for report in self.rounds],
            "success": asdict(success_rate(last.successes)),
            "mean_max_reward": asdict(mean(last.max_rewards)),
        }


@dataclass(frozen=True, kw_only=True)
class RunResult(Result):
    """What one run of a comparison achieved.

    Attributes:
        run: the cell of the matrix.
        steps: gradient steps; None for a policy that is only evaluated.
        seconds: wall-clock by activity, and in total.
        rounds_adopted: rounds that an interrupted run's student met earlier than an uninterrupted one's; runs of this
            version have none.
        made_with: kind (code, packages, teacher, demonstrations) to what it was made with, normally one of each.
        weights: digest of the weights of a policy that was only evaluated.
        ways: in a task with several, which way the kept episodes of every round took.
    """

    run: Run
    steps: int | None
    seconds: Mapping[str, float]
    rounds_adopted: int
    made_with: Mapping[str, frozenset[str]]
    weights: str | None = None
    ways: Sequence[RoundWays] = ()


Methods = Mapping[str, Sequence[RunResult]]
"""Method to its results, one per training seed."""


def estimate(values: Sequence[Any], measure: str) -> Estimate:
    """Mean of a measure with its interval over episodes."""
    return success_rate(values) if measure == "success" else mean(values)


def pooled(results: Sequence[Result], checkpoint: str, measure: str) -> Estimate:
    """Mean of a measure over the episodes of all training seeds; its interval treats episodes as independent."""
    return estimate([value for r in results for value in r.finals[checkpoint].values(measure)], measure)


def difference(
    first: Sequence[RunResult], second: Sequence[RunResult], checkpoint: str, measure: str
) -> Difference | None:
    """Paired difference of two methods over the training seeds that both have; None without a common one.

    A policy that was only evaluated has no training seed and is paired with every seed of the other.
    """
    a, b = (
        {result.run.seed: np.asarray(result.finals[checkpoint].values(measure), float) for result in side}
        for side in (first, second)
    )
    seeds = [seed for seed in a if seed in b or None in b] if None not in a else [*b]
    if not seeds:
        return None
    left, right = ([side.get(seed, side.get(None)) for seed in seeds] for side in (a, b))
    return paired_difference(np.array(left), np.array(right))


def counts(results: Iterable[Result]) -> dict[str, int]:
    """Generated, successful and kept episodes, summed over rounds and training seeds."""
    totals = [report.total for result in results for report in result.rounds]
    return {
        count: sum(getattr(total, count) for total in totals) for count in ("generated", "successful", "kept")
    }
