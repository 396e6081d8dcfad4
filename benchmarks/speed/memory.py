"""The replay as it grows: appending, sampling, bytes per frame."""

from __future__ import annotations

import numpy as np
import torch
from loops import Loop, train_config
from timing import Row, in_turn
from training import ENV, TEACHER

from lerobot_agpd.replay.episode import Episode, EpisodeSpec
from lerobot_agpd.rollout.success import classify

SIZES = (1_000, 10_000, 100_000, 1_000_000)
"""Frames in T."""

LENGTH, EPISODES = 50, 50


def memory(device: str) -> dict[str, Row]:
    """Append a round of 2500 frames to T of several sizes, and draw a batch from it."""
    loops = {size: grown(device, size) for size in SIZES}
    writer = loops[SIZES[0]]
    journal = writer.policy.agpd.journal
    write(writer)
    n_bytes = sum(file.stat().st_size for file in journal.folder(0).iterdir())
    kept = journal.kept(0)
    raw = sum(values.nbytes for values in episode(writer, 0).columns.values()) * EPISODES
    appended = {
        f"append {LENGTH * EPISODES} frames to {size:,}": _extend(loop, kept) for size, loop in loops.items()
    }
    rows = in_turn(appended, turns=7)
    rows |= in_turn(
        {f"draw a batch from {size:,} frames": _draw(loop) for size, loop in loops.items()}, 7, 20
    )
    rows["write a round to the journal"] = in_turn({"": lambda: write(writer)}, turns=3)[""]
    rows["bytes per collected frame, on disk over raw"] = {"ratio": n_bytes / raw}
    table = writer.policy.agpd.replay.table
    rows["bytes per frame in memory"] = {"bytes": table.nbytes / len(table)}
    return rows


def grown(device: str, n_frames: int) -> Loop:
    """A run whose T holds that many frames."""
    loop = Loop(train_config(f"--policy.device={device}", TEACHER, *ENV, preset="student_cpu"))
    loop.step()
    replay = loop.policy.agpd.replay
    n_episodes = max(0, n_frames - len(replay.table)) // LENGTH
    if n_episodes:
        first = len(replay.table)
        columns = {key: column[:LENGTH].repeat(n_episodes, 1) for key, column in replay.table.columns.items()}
        replay.table.append(columns, [LENGTH] * n_episodes)
        for number in range(n_episodes):
            replay._collected_starts.append(first + number * LENGTH, LENGTH)
    return loop


def episode(loop: Loop, number: int) -> Episode:
    """A demonstration as a collected episode."""
    columns = loop.policy.agpd.replay.table.columns
    values = {key: column[:LENGTH].numpy() for key, column in columns.items()}
    actions = values.pop("action")
    success = np.arange(LENGTH) > 1
    return Episode(
        EpisodeSpec(number, number, 0.5), "lift", values, actions, np.zeros(LENGTH, np.float32), success
    )


def write(loop: Loop) -> None:
    """Put a round into a new journal."""
    journal = loop.policy.agpd.journal
    for number in range(EPISODES):
        entry = episode(loop, number)
        journal.append(0, 0, entry, classify(entry, loop.policy.config.collect))


def _extend(loop: Loop, kept: list):
    return lambda: loop.policy.agpd.replay.extend(kept)


def _draw(loop: Loop):
    batch = loop.batch()
    generator = torch.Generator().manual_seed(0)
    return lambda: loop.policy.agpd.replay.train_batch(batch, generator)
