"""Log guided rollouts as rerun recordings.

Every rollout gets an entity of its own, on one timeline `step` that starts at 0 with each of them:

    <root>/frame                     rendered frame (jpeg)
    <root>/frame/{teacher,guided,student}   chunks as line strips on the frame, where actions are positions in it
    <root>/frame/executed            the executed action, as a point on the frame
    <root>/chunk/<d>/{teacher,guided,student}   action dimension d of the chunks, over the steps they are planned for
    <root>/action                    executed actions
    <root>/observation/<name>        vectors as series, cameras as images
    <root>/discrepancy               per decision: J of both chunks to the student's
    <root>/guidance_shift            per decision: mean shift in sigmas
    <root>/reward, <root>/success
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lerobot_agpd.replay.episode import Array
from lerobot_agpd.studies.recording import COLORS, LABELS, DecisionRecord, RolloutRecord

TIMELINE = "step"
JPEG_QUALITY = 85
MAX_SERIES_COLUMNS = 3
LINE_RADIUS = np.asarray(rr.Radius.ui_points(2))  # screen units, independent of zoom
POINT_RADIUS = np.asarray(rr.Radius.ui_points(5))


def log_rollout(stream: rr.RecordingStream, root: str, rollout: RolloutRecord) -> None:
    """Log everything a rollout holds under the entity `root`."""
    episode = rollout.episode
    steps = np.arange(len(episode))
    _log_images(stream, f"{root}/frame", rollout.frames)
    for key, images in rollout.observed(ndim=4).items():
        _log_images(stream, _observation_path(root, key), images)
    for key, vectors in rollout.observed(ndim=2).items():
        _log_series(stream, _observation_path(root, key), steps, vectors)
    _log_series(stream, f"{root}/action", steps, episode.actions)
    _log_series(stream, f"{root}/reward", steps, episode.rewards[:, None], ["reward"])
    if episode.successes is not None:
        _log_series(stream, f"{root}/success", steps, episode.successes[:, None], ["success"])
    if rollout.decisions:
        _log_decisions(stream, root, rollout.decisions)
    if rollout.to_frame is not None:
        _log_overlay(stream, f"{root}/frame", rollout, rollout.to_frame)


def layout(root: str, rollout: RolloutRecord) -> rrb.Container:
    """Arrange one rollout: what happened on the left, what was planned and how it was guided on the right."""
    pictures = [_observation_path(root, key) for key in rollout.observed(ndim=4)]
    if len(rollout.frames) or rollout.to_frame is not None:
        pictures.insert(0, f"{root}/frame")
    n_dims = rollout.episode.actions.shape[1]
    dims = (
        rrb.TimeSeriesView(origin=f"{root}/chunk/{dim}", name=rollout.name_of(dim)) for dim in range(n_dims)
    )
    chunks = rrb.Grid(*dims, grid_columns=min(n_dims, MAX_SERIES_COLUMNS), name="chunks")
    guidance = rrb.Horizontal(
        rrb.TimeSeriesView(origin=f"{root}/discrepancy", name="discrepancy J"),
        rrb.TimeSeriesView(origin=f"{root}/guidance_shift", name="shift in sigmas"),
        rrb.TimeSeriesView(
            origin=root, contents=["$origin/reward", "$origin/success"], name="reward and success"
        ),
    )
    state = rrb.Tabs(
        rrb.TimeSeriesView(origin=f"{root}/action", name="executed actions"),
        *(
            rrb.TimeSeriesView(origin=_observation_path(root, key), name=key)
            for key in rollout.observed(ndim=2)
        ),
    )
    plots = rrb.Vertical(chunks, guidance, state, row_shares=[2, 1, 1])
    if not pictures:
        return rrb.Vertical(plots, name=root)
    views = rrb.Tabs(*(rrb.Spatial2DView(origin=path, name=path.rpartition("/")[2]) for path in pictures))
    return rrb.Horizontal(views, plots, column_shares=[2, 3], name=root)


def blueprint(layouts: Sequence[rrb.Container]) -> rrb.Blueprint:
    """Arrange rollouts in tabs, with the time panel on `step`."""
    return rrb.Blueprint(rrb.Tabs(*layouts), rrb.TimePanel(timeline=TIMELINE), collapse_panels=True)


def _observation_path(root: str, key: str) -> str:
    """`observation.images.top` becomes `<root>/observation/images/top`."""
    return f"{root}/{key.replace('.', '/')}"


def _log_decisions(stream: rr.RecordingStream, root: str, decisions: Sequence[DecisionRecord]) -> None:
    planned = np.concatenate([d.step + np.arange(len(d.chunks["guided"])) for d in decisions])
    for name in COLORS:
        chunks = np.concatenate([d.chunks[name] for d in decisions])  # (decisions * n, A)
        for dim in range(chunks.shape[1]):
            path = f"{root}/chunk/{dim}/{name}"
            _log_series(stream, path, planned, chunks[:, [dim]], [LABELS[name]], [COLORS[name]])
    steps = np.array([d.step for d in decisions])
    discrepancy = np.array([[d.teacher_discrepancy, d.guided_discrepancy] for d in decisions])
    labels = [LABELS["teacher"], LABELS["guided"]]
    _log_series(
        stream, f"{root}/discrepancy", steps, discrepancy, labels, [COLORS["teacher"], COLORS["guided"]]
    )
    shift = np.array([[d.guidance_shift] for d in decisions])
    _log_series(stream, f"{root}/guidance_shift", steps, shift, ["mean shift in sigmas"])


def _log_overlay(
    stream: rr.RecordingStream, path: str, rollout: RolloutRecord, to_frame: Callable[[Array], Array]
) -> None:
    index = rr.TimeColumn(TIMELINE, sequence=[d.step for d in rollout.decisions])
    for name, color in COLORS.items():
        line = rr.LineStrips2D.from_fields(colors=[color], radii=LINE_RADIUS, draw_order=20)
        stream.log(f"{path}/{name}", line, static=True)
        strips = [to_frame(d.chunks[name]) for d in rollout.decisions]
        stream.send_columns(f"{path}/{name}", [index], rr.LineStrips2D.columns(strips=strips))
    point = rr.Points2D.from_fields(colors=[COLORS["guided"]], radii=POINT_RADIUS, draw_order=30)
    stream.log(f"{path}/executed", point, static=True)
    index = rr.TimeColumn(TIMELINE, sequence=np.arange(len(rollout.episode)))
    positions = rr.Points2D.columns(positions=to_frame(rollout.episode.actions))
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
