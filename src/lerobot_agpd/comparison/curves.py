"""Learning curves of all methods, as in the paper's Fig. 4."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lerobot_agpd.comparison.matrix import LABELS, MEASURES
from lerobot_agpd.comparison.results import RunResult


def mean_curve(runs: Sequence[RunResult], measure: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps (K,) that every run has a checkpoint of, and the measure's mean there, (S, K) for S training seeds."""
    steps = sorted(set.intersection(*(set(result.curve) for result in runs)))
    values = [
        [float(np.mean(getattr(result.curve[step], MEASURES[measure]))) for step in steps] for result in runs
    ]
    return np.array(steps), np.array(values).reshape(len(runs), len(steps))


def draw_curves(methods: Mapping[str, Sequence[RunResult]], measure: str, title: str, path: Path) -> None:
    """Mean over training seeds, the range of the seeds shaded, a triangle at each method's maximum.

    A policy that was only evaluated is a dashed line at the mean of its final evaluation.
    """
    figure = Figure(figsize=(8, 4.2), layout="constrained", dpi=150)
    axes = figure.subplots()
    trained = [name for name, runs in methods.items() if runs[0].curve]
    colours = matplotlib.colormaps["tab10" if len(trained) <= 10 else "tab20"]
    for name, runs in methods.items():
        if name in trained:
            _draw_method(axes, name, runs, measure, colours(trained.index(name) % colours.N))
        else:
            level = float(np.mean(getattr(runs[0].finals["last"], MEASURES[measure])))
            axes.axhline(level, color="black", linestyle="--", label=name)
    axes.set(title=title, xlabel="gradient steps", ylabel=LABELS[measure])
    if measure == "success":
        axes.set_ylim(-0.02, 1.02)
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, loc="outside right upper")
    figure.savefig(path)


def _draw_method(axes: Axes, name: str, runs: Sequence[RunResult], measure: str, colour: Any) -> None:
    steps, values = mean_curve(runs, measure)
    if not len(steps):
        return
    centre = values.mean(axis=0)
    axes.plot(steps, centre, color=colour, label=name)
    axes.fill_between(steps, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.15, linewidth=0)
    # Of equal ones the latest, as the best checkpoint is chosen.
    top = int(np.flatnonzero(centre == centre.max())[-1])
    axes.plot(steps[top], centre[top], "^", color=colour, markersize=9, markeredgecolor="white")
