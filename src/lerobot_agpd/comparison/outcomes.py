"""What every method reached, at a glance: one line per method, its interval, and its training seeds one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lerobot_agpd.analysis.statistics import Estimate, mean, success_rate
from lerobot_agpd.comparison.matrix import LABELS, MEASURES
from lerobot_agpd.comparison.results import RunResult


def pooled(runs: Sequence[RunResult], which: str, measure: str) -> Estimate:
    """A measure over the episodes of all training seeds; its interval treats episodes as independent."""
    values = [value for result in runs for value in getattr(result.finals[which], MEASURES[measure])]
    return success_rate(values) if measure == "success" else mean(values)


def draw_outcomes(methods: Mapping[str, Sequence[RunResult]], measure: str, title: str, path: Path) -> None:
    """The last checkpoint's measure: mean and 95 % interval over all episodes, a small dot for every training seed.

    The interval of a policy that was only evaluated is a grey band, for the others to be compared with.
    """
    figure = Figure(figsize=(8, 0.9 + 0.28 * len(methods)), layout="constrained", dpi=150)
    axes = figure.subplots()
    for row, (name, runs) in enumerate(methods.items()):
        _draw_row(axes, row, name, runs, measure)
    axes.set(title=title, xlabel=f"{LABELS[measure]}, last checkpoint")
    axes.set_yticks(range(len(methods)), list(methods))
    axes.invert_yaxis()
    axes.grid(alpha=0.3, axis="x")
    figure.savefig(path)


def _draw_row(axes: Axes, row: int, name: str, runs: Sequence[RunResult], measure: str) -> None:
    estimate = pooled(runs, "last", measure)
    reference = runs[0].steps is None
    if reference:
        axes.axvspan(estimate.low, estimate.high, color="black", alpha=0.1, linewidth=0)
    colour = "black" if reference else "tab:blue"
    axes.plot([estimate.low, estimate.high], [row, row], color=colour, linewidth=2)
    axes.plot(estimate.mean, row, "o", color=colour, markersize=7)
    if len(runs) > 1:
        seeds = [pooled([result], "last", measure).mean for result in runs]
        axes.plot(seeds, [row] * len(seeds), "o", color="white", markeredgecolor=colour, markersize=4)
