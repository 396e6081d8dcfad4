"""The pictures of a comparison: per task what every method reached, and how."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lerobot_agpd.comparison.curves import draw_curves
from lerobot_agpd.comparison.matrix import Matrix
from lerobot_agpd.comparison.outcomes import draw_outcomes
from lerobot_agpd.comparison.results import RunResult


def write_pictures(
    matrix: Matrix, results: Mapping[str, Mapping[str, Sequence[RunResult]]], folder: Path
) -> None:
    """Write `outcomes-<task>.png` and `curves-<task>.png` of every task."""
    for task, methods in results.items():
        entry = matrix.tasks[task]
        for name, draw in (("outcomes", draw_outcomes), ("curves", draw_curves)):
            draw(methods, entry.measure, entry.title or task, folder / f"{name}-{task}.png")
