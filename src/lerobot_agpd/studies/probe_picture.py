"""The picture of a probe: samples at a few states, spread over episodes, pulls, and what steps cost."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lerobot_agpd.replay.episode import Array
from lerobot_agpd.studies.probe import TeacherProbe
from lerobot_agpd.studies.probe_ways import BETWEEN, LEAST_DISTANCE

SHOWN = 4
"""States whose samples are drawn."""

BETWEEN_COLOR = "0.6"


def draw_probe(probe: TeacherProbe, content: Mapping[str, Any], path: Path) -> None:
    """Draw what was measured.

    Args:
        probe: the probe, its samples drawn.
        content: of probe.json.
        path: of the picture.
    """
    figure = Figure(figsize=(3.6 * SHOWN, 7.5), layout="constrained", dpi=120)
    upper, lower = figure.subfigures(2, squeeze=False).ravel()
    states = shown_states(content["states"])
    for axis, state in zip(upper.subplots(1, SHOWN), states + [None] * (SHOWN - len(states)), strict=True):
        if state is None:
            axis.axis("off")
        else:
            _draw_samples(axis, probe, state, content["states"][state])
    spread, pulls, cost = lower.subplots(1, 3)
    _draw_spread(spread, content["states"])
    _draw_pulls(pulls, content["evidence"]["pulls"])
    _draw_cost(cost, content)
    figure.suptitle(f"verdict: {content['verdict']['finding']}")
    figure.savefig(path)


def shown_states(rows: list[dict[str, Any]]) -> list[int]:
    """Numbers of the states to draw: those with the most ways first, then those that spread most."""
    order = sorted(range(len(rows)), key=lambda state: (-rows[state]["n_ways"], -rows[state]["spread"]))
    return order[:SHOWN]


def _draw_samples(axis: Axes, probe: TeacherProbe, state: int, row: Mapping[str, Any]) -> None:
    """Samples of a state in their two principal directions, colored by way."""
    samples, ways = probe.samples[state].flatten(1).numpy(), probe.ways[state]
    target = probe.targets[state].flatten()[None].numpy()
    project = _principal_plane(samples)
    for way in (BETWEEN, *range(len(ways))):
        members = samples[ways.labels == way]
        color = BETWEEN_COLOR if way == BETWEEN else f"C{way % 10}"
        axis.plot(*project(members).T, "o", ms=3, alpha=0.6, color=color)
    marks = {"median": ("X", np.median(samples, axis=0)[None]), "mean": ("P", samples.mean(axis=0)[None])}
    for name, (marker, chunk) in {**marks, "target": ("*", target)}.items():
        axis.plot(*project(chunk).T, marker, ms=9, mfc="none", mec="k", ls="none", label=name)
    half = max(LEAST_DISTANCE, *(abs(bound) for bound in (*axis.get_xlim(), *axis.get_ylim())))
    where = "start" if row["is_start"] else f"frame {row['frame']}"
    title = f"episode {row['episode']}, {where}: {len(ways)} way{'s' * (len(ways) != 1)}"
    axis.set(title=title, xlim=(-half, half), ylim=(-half, 1.3 * half), aspect="equal")
    axis.set(xlabel="first principal direction (rms)", ylabel="second")
    axis.legend(fontsize=7, loc="upper center", ncols=3)


def _principal_plane(samples: Array) -> Any:
    """Map of chunks (N, D) to the plane of the samples' two largest directions, (N, 2), in rms distances."""
    center = samples.mean(axis=0)
    _, _, directions = np.linalg.svd(samples - center, full_matrices=False)
    plane = np.zeros((2, samples.shape[1]))
    plane[: min(2, len(directions))] = directions[:2]
    return lambda chunks: (chunks - center) @ plane.T / np.sqrt(samples.shape[1])


def _draw_spread(axis: Axes, rows: list[dict[str, Any]]) -> None:
    """Spread of the samples over the frames of episodes, colored by the number of ways."""
    for n_ways in sorted({row["n_ways"] for row in rows}):
        chosen = [row for row in rows if row["n_ways"] == n_ways]
        label = f"{n_ways} way{'s' * (n_ways != 1)}, {len(chosen)} states"
        x, y = ([row[key] for row in chosen] for key in ("frame", "spread"))
        axis.plot(x, y, "o", ms=4, alpha=0.7, label=label)
    axis.set(xlabel="frame of its episode", ylabel="spread of the teacher's samples", ylim=(0, None))
    axis.legend(fontsize=8)


def _draw_pulls(axis: Axes, pulls: list[dict[str, Any]]) -> None:
    """How far each strategy moves chunks to the target, and how often it chooses its way."""
    names = [pull["strategy"] + (f" {pull['strength']:g}" if pull["strength"] else "") for pull in pulls]
    places = np.arange(len(pulls))
    keys = {"moved": "moved to the target", "chooses": "chooses its way", "off": "off the ways"}
    for number, (key, label) in enumerate(keys.items()):
        values = [pull[key] for pull in pulls]
        if None not in values:
            axis.bar(places + 0.27 * (number - 1), values, 0.25, label=label)
    axis.set_xticks(places, names, rotation=30, ha="right")
    axis.set(ylabel="fraction", ylim=(min(0.0, *(pull["moved"] for pull in pulls)), 1.2))
    axis.legend(fontsize=8, loc="upper center", ncols=len(keys))


def _draw_cost(axis: Axes, content: Mapping[str, Any]) -> None:
    """Success against milliseconds per chunk; milliseconds by steps if success was not measured."""
    times = [row["milliseconds"] for row in content["latency"]]
    steps = [row["steps"] for row in content["latency"]]
    if not content["success"]:
        axis.plot(range(len(times)), times, "o-")
        axis.set_xticks(range(len(times)), [str(count or "-") for count in steps])
        axis.set(xlabel="denoising steps", ylabel="ms per chunk", ylim=(0, None))
        return
    means, lows, highs = (
        np.array([row[key] for row in content["success"]]) for key in ("mean", "low", "high")
    )
    axis.errorbar(times, means, yerr=(means - lows, highs - means), fmt="o-", capsize=3)
    for count, time, mean in zip(steps, times, means, strict=True):
        axis.annotate(str(count or ""), (time, mean), xytext=(4, -10), textcoords="offset points", fontsize=8)
    axis.set(xlabel="ms per chunk (labels: denoising steps)", ylabel="teacher's success", ylim=(0, 1.05))
