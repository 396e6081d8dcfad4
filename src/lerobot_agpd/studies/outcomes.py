"""One picture of what every method achieved: a line per method, its interval, and its training seeds one by one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lerobot_agpd.studies.matrix import LABELS
from lerobot_agpd.studies.results import Methods, RunResult, pooled


def draw_outcomes(methods: Methods, measure: str, title: str, path: Path) -> None:
    """The last checkpoint's measure: a thick bar spans the training seeds, a thin one the interval of a single seed.

    The thin bar covers environments only. A policy that was only evaluated is black, its interval a gray band.
    """
    figure = Figure(figsize=(8, 0.9 + 0.28 * len(methods)), layout="constrained", dpi=150)
    axes = figure.subplots()
    for row, runs in enumerate(methods.values()):
        _draw_row(axes, row, runs, measure)
    axes.set(title=title, xlabel=f"{LABELS[measure]}, last checkpoint")
    axes.set_yticks(range(len(methods)), [_label(name, runs) for name, runs in methods.items()])
    axes.invert_yaxis()
    axes.grid(alpha=0.3, axis="x")
    figure.savefig(path)


def _label(name: str, runs: Sequence[RunResult]) -> str:
    if runs[0].steps is None:
        return name
    return f"{name} ({len(runs)} seed{'s' * (len(runs) != 1)})"


def _draw_row(axes: Axes, row: int, runs: Sequence[RunResult], measure: str) -> None:
    estimate = pooled(runs, "last", measure)
    if len(runs) > 1:
        seeds = [pooled([result], "last", measure).mean for result in runs]
        axes.plot([min(seeds), max(seeds)], [row, row], color="tab:blue", linewidth=5, alpha=0.4)
        axes.plot(seeds, [row] * len(seeds), "o", color="white", markeredgecolor="tab:blue", markersize=4)
        axes.plot(estimate.mean, row, "o", color="tab:blue", markersize=7)
        return
    evaluated = runs[0].steps is None
    if evaluated:
        axes.axvspan(estimate.low, estimate.high, color="black", alpha=0.1, linewidth=0)
    color = "black" if evaluated else "tab:blue"
    axes.plot([estimate.low, estimate.high], [row, row], color=color, linewidth=1)
    axes.plot(estimate.mean, row, "o", color=color, markerfacecolor="white", markersize=7)
