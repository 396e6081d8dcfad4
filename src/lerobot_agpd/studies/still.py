"""Draw one picture of a guided rollout: the chunks of a decision, and J over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from lerobot_agpd.studies.recording import COLORS, LABELS, DecisionRecord, RolloutRecord


def draw_still(rollout: RolloutRecord, path: Path) -> None:
    """Draw the chunks of one decision, and J over the whole rollout.

    The decision is the one of the rollout's middle half at which teacher and student disagree most. Its chunks lie
    on the rendered frame where actions are positions in it, else each action dimension gets a plot.
    """
    n_decisions = len(rollout.decisions)
    middle = rollout.decisions[n_decisions // 4 : n_decisions - n_decisions // 4]
    decision = max(middle, key=lambda candidate: candidate.teacher_discrepancy)
    draw = _draw_dimensions if rollout.to_frame is None else _draw_on_frame
    figure = draw(rollout, decision)
    handles = [Line2D([], [], color=_rgb(name), marker=".", label=LABELS[name]) for name in COLORS]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    figure.savefig(path)


def _draw_on_frame(rollout: RolloutRecord, decision: DecisionRecord) -> Figure:
    """Draw the frame with the chunks on it, the part of it around them, and J."""
    assert rollout.to_frame is not None
    chunks = {name: rollout.to_frame(chunk) for name, chunk in decision.chunks.items()}
    figure = Figure(figsize=(11, 6.5), layout="constrained", dpi=120)
    panels = figure.subplot_mosaic([["frame", "closer"], ["frame", "discrepancy"]], width_ratios=[3, 2])
    for axes in (panels["frame"], panels["closer"]):
        if len(rollout.frames):
            axes.imshow(rollout.frames[decision.step])
        axes.set(aspect="equal", xticks=[], yticks=[])
        for name, chunk in chunks.items():
            axes.plot(*chunk.T, ".-", color=_rgb(name), linewidth=2, markersize=7)
            axes.plot(*chunk[0], "o", color=_rgb(name), markersize=9, markeredgecolor="white")
    points = np.concatenate(list(chunks.values()))
    center, reach = (points.min(axis=0) + points.max(axis=0)) / 2, 0.7 * np.ptp(points, axis=0).max() + 1e-3
    x, y = center - reach
    panels["closer"].set(xlim=(x, x + 2 * reach), ylim=(y + 2 * reach, y), title="closer")
    panels["frame"].add_patch(
        Rectangle((x, y), 2 * reach, 2 * reach, fill=False, color="gray", linestyle=":")
    )
    if not len(rollout.frames):
        panels["frame"].invert_yaxis()
    panels["frame"].set_title(f"Chunks decided at step {decision.step} (from the large dots on)")
    _plot_discrepancy(panels["discrepancy"], rollout.decisions, decision)
    return figure


def _draw_dimensions(rollout: RolloutRecord, decision: DecisionRecord) -> Figure:
    """Draw a plot per action dimension, J, and the frame if there is one."""
    n_dims = rollout.episode.actions.shape[1]
    n_columns = 1 if n_dims < 2 else 2 if n_dims <= 8 else 4
    n_rows = -(-n_dims // n_columns)
    figure = Figure(figsize=(5 + 3.2 * n_columns, max(6, 1.8 * n_rows)), layout="constrained", dpi=120)
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=[5, 3.2 * n_columns]))
    grid = right.subplots(n_rows, n_columns, squeeze=False).ravel()
    for dim, axes in enumerate(grid[:n_dims]):
        for name, chunk in decision.chunks.items():
            axes.plot(decision.step + np.arange(len(chunk)), chunk[:, dim], ".-", color=_rgb(name))
        axes.set_title(rollout.name_of(dim), fontsize="medium")
        if dim >= n_dims - n_columns:
            axes.set_xlabel("step")
    for axes in grid[n_dims:]:
        axes.set_axis_off()
    if len(rollout.frames):
        picture, below = left.subplots(2, 1, height_ratios=[2, 1])
        picture.imshow(rollout.frames[decision.step])
        picture.set_title(f"step {decision.step}")
        picture.set_axis_off()
    else:
        below = left.subplots()
    _plot_discrepancy(below, rollout.decisions, decision)
    return figure


def _plot_discrepancy(axes: Axes, decisions: Sequence[DecisionRecord], shown: DecisionRecord) -> None:
    steps = [d.step for d in decisions]
    axes.plot(steps, [d.teacher_discrepancy for d in decisions], ".-", color=_rgb("teacher"))
    axes.plot(steps, [d.guided_discrepancy for d in decisions], ".-", color=_rgb("guided"))
    axes.axvline(shown.step, color="gray", linestyle=":")
    axes.set(title="J to the student's chunk", xlabel="step")
    axes.set_ylim(bottom=0)


def _rgb(name: str) -> tuple[float, float, float]:
    red, green, blue = COLORS[name]
    return red / 255, green / 255, blue / 255
