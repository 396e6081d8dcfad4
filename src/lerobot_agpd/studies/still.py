"""Draw one picture of a guided rollout: the chunks of a decision, and J over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lerobot_agpd.studies.recording import COLORS, LABELS, DecisionRecord, RolloutRecord

RGB = {name: tuple(value / 255 for value in color) for name, color in COLORS.items()}


def draw_still(rollout: RolloutRecord, path: Path) -> None:
    """Draw the chunks of one decision, a plot per action dimension, and J over the whole rollout.

    The decision is the one of the rollout's middle half at which teacher and student disagree most. If there are
    rendered frames, the one of its step is shown beside.
    """
    quarter = len(rollout.decisions) // 4
    middle = rollout.decisions[quarter : len(rollout.decisions) - quarter]
    decision = max(middle, key=lambda candidate: candidate.teacher_discrepancy)
    n_dims = rollout.episode.actions.shape[1]
    n_columns = 1 if n_dims < 2 else 2 if n_dims <= 8 else 4
    n_rows = -(-n_dims // n_columns)
    figure = Figure(figsize=(5 + 3.2 * n_columns, max(6, 1.8 * n_rows)), layout="constrained", dpi=120)
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=[5, 3.2 * n_columns]))
    grid = right.subplots(n_rows, n_columns, squeeze=False).ravel()
    for dim, axes in enumerate(grid):
        axes.set_title(f"action {dim}", fontsize="medium")
        axes.set_visible(dim < n_dims)
    for name, chunk in decision.chunks.items():
        steps = decision.step + np.arange(len(chunk))
        for axes, values in zip(grid, chunk.T, strict=False):
            axes.plot(steps, values, ".-", color=RGB[name], label=LABELS[name])
    *pictures, below = left.subplots(2 if len(rollout.frames) else 1, 1, squeeze=False).ravel()
    for axes in pictures:
        axes.imshow(rollout.frames[decision.step])
        axes.set(title=f"step {decision.step}", xticks=[], yticks=[])
    _plot_discrepancy(below, rollout.decisions, decision)
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(path)


def _plot_discrepancy(axes: Axes, decisions: Sequence[DecisionRecord], shown: DecisionRecord) -> None:
    steps = [d.step for d in decisions]
    axes.plot(steps, [d.teacher_discrepancy for d in decisions], ".-", color=RGB["teacher"])
    axes.plot(steps, [d.guided_discrepancy for d in decisions], ".-", color=RGB["guided"])
    axes.axvline(shown.step, color="gray", linestyle=":")
    axes.set(title="J to the student's chunk", xlabel="step")
    axes.set_ylim(bottom=0)
