"""Learning curves: one panel per task in a comparison (the paper's Fig. 4), three panels in the report of some runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lerobot_agpd.rollout.report import RoundReport, success_rate
from lerobot_agpd.studies.matrix import LABELS
from lerobot_agpd.studies.results import Result, estimate, pooled

Runs = Mapping[str, Sequence[Result]]
"""Method to its results, one per training seed."""

Color = str | tuple[float, ...]


def mean_curve(runs: Sequence[Result], measure: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps (K,) that every run has a checkpoint of, and the measure's mean there, (S, K) for S training seeds."""
    steps = sorted(set.intersection(*(set(result.curve) for result in runs)))
    values = [[result.curve[step].mean(measure) for step in steps] for result in runs]
    return np.array(steps), np.array(values).reshape(len(runs), len(steps))


def draw_task_curves(methods: Runs, measure: str, title: str, path: Path) -> None:
    """Mean over training seeds, the range of the seeds shaded, a triangle at each method's maximum.

    A policy that was only evaluated is a dashed line at the mean of its final evaluation.
    """
    figure = Figure(figsize=(8, 4.2), layout="constrained", dpi=150)
    axes = figure.subplots()
    _draw_curves(axes, methods, measure, intervals=False)
    axes.set(title=title)
    figure.legend(fontsize=8, loc="outside right upper")
    figure.savefig(path)


def draw_report_curves(results: Sequence[Result], title: str, path: Path) -> None:
    """Success and reward with their 95 % intervals, and the collection rounds of the first run that has some."""
    figure = Figure(figsize=(13, 3.8), layout="constrained", dpi=120)
    success, reward, collection = figure.subplots(1, 3)
    methods = {result.name: [result] for result in results}
    _draw_curves(success, methods, "success", intervals=True)
    _draw_curves(reward, methods, "max_reward", intervals=True)
    success.legend(loc="lower right", fontsize=8)
    _draw_rounds(collection, next((result.rounds for result in results if result.rounds), ()))
    figure.suptitle(title)
    figure.savefig(path)


def _draw_curves(axes: Axes, methods: Runs, measure: str, intervals: bool) -> None:
    trained = [name for name, runs in methods.items() if runs[0].curve]
    order = [*trained, *(name for name in methods if name not in trained)]
    palette = matplotlib.colormaps["tab10" if len(order) <= 10 else "tab20"]
    for name, runs in methods.items():
        color: Color = palette(order.index(name) % palette.N)
        if name in trained:
            _draw_curve(axes, name, runs, measure, color, intervals)
            continue
        color = "black" if len(order) == len(trained) + 1 else color
        level = pooled(runs, "last", measure)
        axes.axhline(level.mean, color=color, linestyle="--", label=name)
        if intervals:
            axes.axhspan(level.low, level.high, color=color, alpha=0.1, linewidth=0)
    axes.set(xlabel="gradient steps", ylabel=LABELS[measure])
    if not trained:  # levels alone, which have no steps
        axes.set(xlabel="", xticks=[])
    if measure == "success":
        axes.set_ylim(-0.02, 1.02)
    axes.grid(alpha=0.3)


def _draw_curve(
    axes: Axes, name: str, runs: Sequence[Result], measure: str, color: Color, intervals: bool
) -> None:
    steps, values = mean_curve(runs, measure)
    if not len(steps):
        return
    center, low, high = values.mean(axis=0), values.min(axis=0), values.max(axis=0)
    if intervals:
        points = [estimate(runs[0].curve[step].values(measure), measure) for step in steps]
        low, high = (np.array([getattr(point, side) for point in points]) for side in ("low", "high"))
    axes.plot(steps, center, color=color, label=name)
    axes.fill_between(steps, low, high, color=color, alpha=0.15, linewidth=0)
    # Of equal ones the latest, as the best checkpoint is chosen.
    top = int(np.flatnonzero(center == center.max())[-1])
    axes.plot(steps[top], center[top], "^", color=color, markersize=9, markeredgecolor="white")


def _draw_rounds(axes: Axes, rounds: Sequence[RoundReport]) -> None:
    """Success of the strategy and of the teacher alone in every round, and the strength that was used."""
    axes.set(title="collection rounds", xlabel="round", ylim=(-0.02, 1.02), ylabel="success rate")
    for label, style in (("strategy", "o-"), ("teacher only", "s--")):
        kind = label.replace(" ", "_")
        rates = {report.round: success_rate([getattr(report, kind)]) for report in rounds}
        points = [(number, rate) for number, rate in rates.items() if rate is not None]
        if points:
            axes.plot(*zip(*points, strict=True), style, label=label, markersize=4)
    if rounds:
        strength = axes.twinx()
        numbers, strengths = zip(*((report.round, report.strength) for report in rounds), strict=True)
        strength.plot(numbers, strengths, "k:", linewidth=1)
        strength.set(ylabel="strength (dotted)", ylim=(0, None))
        axes.legend(loc="lower right", fontsize=8)
