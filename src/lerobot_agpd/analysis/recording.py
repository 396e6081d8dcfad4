"""Pictures of guided rollouts: a rerun recording, and one still.

Every rollout gets an entity of its own, on one timeline `step` that starts at 0 with each of them:

    <root>/frame                     rendered frame (jpeg)
    <root>/frame/{teacher,guided,student}   chunks as line strips on the frame, where actions are positions in it
    <root>/frame/executed            the executed action, as a point on the frame
    <root>/chunk/<d>/{teacher,guided,student}   action dimension d of the chunks, over the steps they are planned for
    <root>/action                    executed actions
    <root>/observation/<name>        vectors as series, cameras as images
    <root>/J, <root>/shift           per decision: discrepancy of both chunks to the student's, and mean guidance shift
    <root>/reward, <root>/success
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

Array = NDArray[Any]

TIMELINE = "step"
JPEG_QUALITY = 85
MAX_SERIES_COLUMNS = 3
LINE_RADIUS = np.asarray(rr.Radius.ui_points(2))  # screen units, independent of zoom
POINT_RADIUS = np.asarray(rr.Radius.ui_points(5))

COLORS = {"teacher": (0, 114, 178), "guided": (213, 94, 0), "student": (230, 60, 180)}
LABELS = {"teacher": "teacher alone", "guided": "guided teacher", "student": "student"}


@dataclass(frozen=True)
class Chunks:
    """The three chunks of one decision, (n, A) in the environment's units.

    Attributes:
        teacher: without guidance, from the same initial noise as `guided`.
        guided: pulled toward the student; executed.
        student: what it was pulled toward.
    """

    teacher: Array
    guided: Array
    student: Array

    def items(self) -> list[tuple[str, Array]]:
        """Names and chunks."""
        return [(field.name, getattr(self, field.name)) for field in fields(self)]


@dataclass(frozen=True)
class DecisionRecord:
    """One decision.

    Attributes:
        step: environment step at which the chunks begin.
        chunks: the three chunks.
        j_teacher: discrepancy J between the unguided chunk and the student's.
        j_guided: discrepancy J between the executed chunk and the student's.
        shift_in_sigmas: mean shift of the guided denoising steps; NaN if unguided.
    """

    step: int
    chunks: Chunks
    j_teacher: float
    j_guided: float
    shift_in_sigmas: float


@dataclass(frozen=True)
class RolloutRecord:
    """A rollout of T steps.

    Attributes:
        observations: feature name to (T, D) vectors or (T, H, W, C) uint8 images.
        actions: (T, A) as executed.
        rewards: (T,).
        successes: (T,) bool, or None if the environment does not say.
        decisions: in the order of their steps.
        frames: T rendered frames (H, W, 3) uint8, or none.
        to_frame: maps actions (n, 2) to pixels (n, 2) of the frame; None if actions are no positions in it.
    """

    observations: Mapping[str, Array]
    actions: Array
    rewards: Array
    successes: Array | None
    decisions: Sequence[DecisionRecord]
    frames: Sequence[Array] = ()
    to_frame: Callable[[Array], Array] | None = None

    @property
    def cameras(self) -> list[str]:
        """Observations that are images."""
        return [key for key, values in self.observations.items() if values.ndim == 4]

    @property
    def vectors(self) -> list[str]:
        """Observations that are vectors."""
        return [key for key, values in self.observations.items() if values.ndim == 2]


# ---- rerun ----


def log_rollout(stream: rr.RecordingStream, root: str, rollout: RolloutRecord) -> None:
    """Log everything a rollout holds under the entity `root`."""
    steps = np.arange(len(rollout.actions))
    _log_images(stream, f"{root}/frame", rollout.frames)
    for key in rollout.cameras:
        _log_images(stream, _observation_path(root, key), rollout.observations[key])
    for key in rollout.vectors:
        _log_series(stream, _observation_path(root, key), steps, rollout.observations[key])
    _log_series(stream, f"{root}/action", steps, rollout.actions)
    _log_series(stream, f"{root}/reward", steps, rollout.rewards[:, None], ["reward"])
    if rollout.successes is not None:
        _log_series(stream, f"{root}/success", steps, rollout.successes[:, None], ["success"])
    if rollout.decisions:
        _log_decisions(stream, root, rollout.decisions)
    if rollout.to_frame is not None:
        _log_overlay(stream, f"{root}/frame", rollout, rollout.to_frame)


def layout(root: str, rollout: RolloutRecord) -> rrb.Container:
    """Views of one rollout: what happened on the left, what was planned and how it was guided on the right."""
    pictures = [_observation_path(root, key) for key in rollout.cameras]
    if len(rollout.frames) or rollout.to_frame is not None:
        pictures.insert(0, f"{root}/frame")
    chunks = rrb.Grid(
        *(
            rrb.TimeSeriesView(origin=f"{root}/chunk/{dim}", name=f"action {dim}")
            for dim in range(rollout.actions.shape[1])
        ),
        grid_columns=min(rollout.actions.shape[1], MAX_SERIES_COLUMNS),
        name="chunks",
    )
    guidance = rrb.Horizontal(
        rrb.TimeSeriesView(origin=f"{root}/J", name="J"),
        rrb.TimeSeriesView(origin=f"{root}/shift", name="shift in sigmas"),
        rrb.TimeSeriesView(
            origin=root, contents=["$origin/reward", "$origin/success"], name="reward and success"
        ),
    )
    state = rrb.Tabs(
        rrb.TimeSeriesView(origin=f"{root}/action", name="executed actions"),
        *(rrb.TimeSeriesView(origin=_observation_path(root, key), name=key) for key in rollout.vectors),
    )
    plots = rrb.Vertical(chunks, guidance, state, row_shares=[2, 1, 1])
    if not pictures:
        return rrb.Vertical(plots, name=root)
    views = rrb.Tabs(*(rrb.Spatial2DView(origin=path, name=path.rpartition("/")[2]) for path in pictures))
    return rrb.Horizontal(views, plots, column_shares=[2, 3], name=root)


def blueprint(layouts: Sequence[rrb.Container]) -> rrb.Blueprint:
    """One tab per rollout, with the time panel on `step`."""
    return rrb.Blueprint(rrb.Tabs(*layouts), rrb.TimePanel(timeline=TIMELINE), collapse_panels=True)


def _observation_path(root: str, key: str) -> str:
    """`observation.images.top` becomes `<root>/observation/images/top`."""
    return f"{root}/{key.replace('.', '/')}"


def _log_decisions(stream: rr.RecordingStream, root: str, decisions: Sequence[DecisionRecord]) -> None:
    planned = np.concatenate([d.step + np.arange(len(d.chunks.guided)) for d in decisions])
    for name in COLORS:
        chunks = np.concatenate([getattr(d.chunks, name) for d in decisions])  # (decisions * n, A)
        for dim in range(chunks.shape[1]):
            path = f"{root}/chunk/{dim}/{name}"
            _log_series(stream, path, planned, chunks[:, [dim]], [LABELS[name]], [COLORS[name]])
    steps = np.array([d.step for d in decisions])
    j = np.array([[d.j_teacher, d.j_guided] for d in decisions])
    labels = [LABELS["teacher"], LABELS["guided"]]
    _log_series(stream, f"{root}/J", steps, j, labels, [COLORS["teacher"], COLORS["guided"]])
    shift = np.array([[d.shift_in_sigmas] for d in decisions])
    _log_series(stream, f"{root}/shift", steps, shift, ["mean shift in sigmas"])


def _log_overlay(
    stream: rr.RecordingStream, path: str, rollout: RolloutRecord, to_frame: Callable[[Array], Array]
) -> None:
    index = rr.TimeColumn(TIMELINE, sequence=[d.step for d in rollout.decisions])
    for name, color in COLORS.items():
        line = rr.LineStrips2D.from_fields(colors=[color], radii=LINE_RADIUS, draw_order=20)
        stream.log(f"{path}/{name}", line, static=True)
        strips = [to_frame(getattr(d.chunks, name)) for d in rollout.decisions]
        stream.send_columns(f"{path}/{name}", [index], rr.LineStrips2D.columns(strips=strips))
    point = rr.Points2D.from_fields(colors=[COLORS["guided"]], radii=POINT_RADIUS, draw_order=30)
    stream.log(f"{path}/executed", point, static=True)
    index = rr.TimeColumn(TIMELINE, sequence=np.arange(len(rollout.actions)))
    positions = rr.Points2D.columns(positions=to_frame(rollout.actions))
    stream.send_columns(f"{path}/executed", [index], positions)


def _log_series(
    stream: rr.RecordingStream,
    path: str,
    steps: Array,
    values: Array,
    names: Sequence[str] | None = None,
    colors: Sequence[tuple[int, int, int]] | None = None,
) -> None:
    """Log D series (T, D) at the given steps (T,)."""
    names = names or [str(dim) for dim in range(values.shape[1])]
    stream.log(path, rr.SeriesLines(names=names, colors=colors), static=True)
    index = rr.TimeColumn(TIMELINE, sequence=steps)
    stream.send_columns(path, [index], rr.Scalars.columns(scalars=values.astype(np.float64)))


def _log_images(stream: rr.RecordingStream, path: str, images: Sequence[Array] | Array) -> None:
    for step, image in enumerate(images):
        stream.set_time(TIMELINE, sequence=step)
        stream.log(path, rr.Image(image).compress(jpeg_quality=JPEG_QUALITY))
    stream.reset_time()


# ---- the still ----


def draw_still(rollout: RolloutRecord, path: Path) -> None:
    """Draw the chunks of one decision, and J over the whole rollout.

    The decision is the one of the rollout's middle half at which teacher and student disagree most. Its chunks lie
    on the rendered frame where actions are positions in it, else each action dimension gets a plot.
    """
    n_decisions = len(rollout.decisions)
    middle = rollout.decisions[n_decisions // 4 : n_decisions - n_decisions // 4]
    decision = max(middle, key=lambda candidate: candidate.j_teacher)
    draw = _draw_dimensions if rollout.to_frame is None else _draw_on_frame
    figure = draw(rollout, decision)
    handles = [Line2D([], [], color=_rgb(name), marker=".", label=LABELS[name]) for name in COLORS]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    figure.savefig(path)


def _draw_on_frame(rollout: RolloutRecord, decision: DecisionRecord) -> Figure:
    """The frame with the chunks on it, the part of it around them, and J."""
    assert rollout.to_frame is not None
    chunks = {name: rollout.to_frame(chunk) for name, chunk in decision.chunks.items()}
    figure = Figure(figsize=(11, 6.5), layout="constrained", dpi=120)
    panels = figure.subplot_mosaic([["frame", "closer"], ["frame", "j"]], width_ratios=[3, 2])
    for axes in (panels["frame"], panels["closer"]):
        if len(rollout.frames):
            axes.imshow(rollout.frames[decision.step])
        axes.set(aspect="equal", xticks=[], yticks=[])
        for name, chunk in chunks.items():
            axes.plot(*chunk.T, ".-", color=_rgb(name), linewidth=2, markersize=7)
            axes.plot(*chunk[0], "o", color=_rgb(name), markersize=9, markeredgecolor="white")
    points = np.concatenate(list(chunks.values()))
    centre, reach = (points.min(axis=0) + points.max(axis=0)) / 2, 0.7 * np.ptp(points, axis=0).max() + 1e-3
    x, y = centre - reach
    panels["closer"].set(xlim=(x, x + 2 * reach), ylim=(y + 2 * reach, y), title="closer")
    panels["frame"].add_patch(
        Rectangle((x, y), 2 * reach, 2 * reach, fill=False, color="gray", linestyle=":")
    )
    if not len(rollout.frames):
        panels["frame"].invert_yaxis()
    panels["frame"].set_title(f"Chunks decided at step {decision.step} (from the large dots on)")
    _plot_j(panels["j"], rollout.decisions, decision)
    return figure


def _draw_dimensions(rollout: RolloutRecord, decision: DecisionRecord) -> Figure:
    """A plot per action dimension, J, and the frame if there is one."""
    n_dims = rollout.actions.shape[1]
    n_columns = 1 if n_dims < 2 else 2 if n_dims <= 8 else 4
    n_rows = -(-n_dims // n_columns)
    figure = Figure(figsize=(5 + 3.2 * n_columns, max(6, 1.8 * n_rows)), layout="constrained", dpi=120)
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=[5, 3.2 * n_columns]))
    grid = right.subplots(n_rows, n_columns, squeeze=False).ravel()
    for dim, axes in enumerate(grid[:n_dims]):
        for name, chunk in decision.chunks.items():
            axes.plot(decision.step + np.arange(len(chunk)), chunk[:, dim], ".-", color=_rgb(name))
        axes.set_title(f"action {dim}", fontsize="medium")
        if dim >= n_dims - n_columns:
            axes.set_xlabel("step")
    for axes in grid[n_dims:]:
        axes.set_axis_off()
    if len(rollout.frames):
        picture, axes_j = left.subplots(2, 1, height_ratios=[2, 1])
        picture.imshow(rollout.frames[decision.step])
        picture.set_title(f"step {decision.step}")
        picture.set_axis_off()
    else:
        axes_j = left.subplots()
    _plot_j(axes_j, rollout.decisions, decision)
    return figure


def _plot_j(axes: Axes, decisions: Sequence[DecisionRecord], shown: DecisionRecord) -> None:
    steps = [d.step for d in decisions]
    axes.plot(steps, [d.j_teacher for d in decisions], ".-", color=_rgb("teacher"))
    axes.plot(steps, [d.j_guided for d in decisions], ".-", color=_rgb("guided"))
    axes.axvline(shown.step, color="gray", linestyle=":")
    axes.set(title="J to the student's chunk", xlabel="step")
    axes.set_ylim(bottom=0)


def _rgb(name: str) -> tuple[float, float, float]:
    red, green, blue = COLORS[name]
    return red / 255, green / 255, blue / 255
