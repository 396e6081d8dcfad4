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
    """Write `outcomes-<task>.png` of all methods and `curves-<task>.png` of the references, for every task."""
    for task, methods in results.items():
        entry = matrix.tasks[task]
        title = entry.title or task
        draw_outcomes(methods, entry.measure, title, folder / f"outcomes-{task}.png")
        shown = {name: runs for name, runs in methods.items() if name in (matrix.references or methods)}
        draw_curves(shown, entry.measure, title, folder / f"curves-{task}.png")
