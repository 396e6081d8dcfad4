"""Pictures of a sweep over collection strategies: the price of diversity, and where episodes go (Fig. 1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from lerobot_agpd.replay.episode import Episode

COLORS = {"teacher": "k", "guided": "C1", "interpolate": "C0", "switch": "C2"}
NAMES = {
    "teacher": "teacher alone",
    "guided": "guided (Eq. 20)",
    "interpolate": "mixing (Eq. 6)",
    "switch": "mixing (Eq. 7)",
}
PANELS = (
    ("entropy", "entropy of visited states (nats)"),
    ("coverage", "student's states covered"),
    ("success", "success rate"),
)


def plot_frontier(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Diversity, coverage and success against the distance of executed actions from the teacher's.

    Args:
        rows: the `SweepRow` of every setting, as JSON.
        path: of the picture.
    """
    figure = Figure(figsize=(13, 4), layout="constrained", dpi=120)
    axes = figure.subplots(1, len(PANELS))
    for axis, (key, label) in zip(axes, PANELS, strict=True):
        for strategy in dict.fromkeys(row["setting"]["strategy"] for row in rows):
            points = sorted(
                (row["actions"]["rms_to_teacher"], row[key], row["setting"]["strength"])
                for row in rows
                if row["setting"]["strategy"] == strategy and row[key] is not None
            )
            if strategy == "teacher":
                axis.axhline(points[0][1], color="k", ls=":", lw=1, label=NAMES[strategy])
                continue
            x, y = ([point[side] for point in points] for side in (0, 1))
            axis.plot(x, y, "o-", ms=4, color=COLORS[strategy], label=NAMES[strategy])
            for distance, value, strength in points:
                axis.annotate(
                    f"{strength:g}", (distance, value), fontsize=7, xytext=(3, 3), textcoords="offset points"
                )
        axis.set(xlabel="rms distance of actions from the teacher's", ylabel=label, xscale="log")
        # A sweep may span less than one decade.
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.xaxis.set_minor_formatter(NullFormatter())  # labels of minor ticks would overlap
    axes[0].legend(fontsize=8)
    figure.savefig(path)


def plot_trajectories(
    episodes: Mapping[str, Sequence[Episode]], dims: tuple[int, int], path: Path, limit: int = 12
) -> None:
    """Paths of episodes from the same starts, one panel per policy.

    Args:
        episodes: name of the policy to its episodes, in the same order of environment seeds.
        dims: the two dimensions of observation.state to draw.
        path: of the picture.
        limit: episodes drawn.
    """
    figure = Figure(figsize=(4.2 * len(episodes), 4), layout="constrained", dpi=120)
    axes = figure.subplots(1, len(episodes), sharex=True, sharey=True)
    for axis, (name, played) in zip(np.atleast_1d(axes), episodes.items(), strict=True):
        for number, episode in enumerate(played[:limit]):
            states = episode.observations["observation.state"]
            axis.plot(*states[:, list(dims)].T, color=f"C{number % 10}", lw=1, alpha=0.8)
            axis.plot(*states[0, list(dims)], "o", color=f"C{number % 10}", ms=3)
        axis.set(title=name, xlabel=f"state {dims[0]}", ylabel=f"state {dims[1]}", aspect="equal")
    figure.savefig(path)
