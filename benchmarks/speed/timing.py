"""Time several actions in turn, so that a machine that slows down slows all of them."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping

import torch

Action = Callable[[], object]
Row = dict[str, float]
"""Median milliseconds of an action: `cpu_ms` of this process with all its threads, `wall_ms`; and `ratio`, the median of its CPU
time over the first action's, turn by turn (of its wall time on an accelerator)."""


def milliseconds(action: Action, calls: int) -> tuple[float, float]:
    """CPU and wall time of a call, averaged over `calls`, with what it left running on an accelerator."""
    cpu, wall = time.process_time(), time.perf_counter()
    for _ in range(calls):
        action()
    if torch.accelerator.is_available():
        torch.accelerator.synchronize()
    return 1e3 * (time.process_time() - cpu) / calls, 1e3 * (time.perf_counter() - wall) / calls


def in_turn(actions: Mapping[str, Action], turns: int, calls: int = 1, warmup: int = 1) -> dict[str, Row]:
    """Run every action `calls` times per turn.

    Args:
        actions: name to what is timed; the first one is what the others are compared with.
        turns: how often.
        calls: of an action per turn.
        warmup: turns that are not timed.
    """
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in actions}
    for turn in range(warmup + turns):
        for name, action in actions.items():
            gc.collect()
            times = milliseconds(action, calls)
            if turn >= warmup:
                taken[name].append(times)
    return {name: _row(times, next(iter(taken.values()))) for name, times in taken.items()}


def _row(times: list[tuple[float, float]], reference: list[tuple[float, float]]) -> Row:
    measured = 1 if torch.accelerator.is_available() else 0
    ratios = [ours[measured] / theirs[measured] for ours, theirs in zip(times, reference, strict=True)]
    cpu, wall = (statistics.median(column) for column in zip(*times, strict=True))
    return {"cpu_ms": cpu, "wall_ms": wall, "ratio": statistics.median(ratios)}
