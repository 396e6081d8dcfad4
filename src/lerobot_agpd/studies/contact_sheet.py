"""A contact sheet of a collection round: where its kept episodes ended, and where those began that were dropped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.envs import EnvConfig, close_envs, make_env
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.utils.constants import ACTION
from PIL import Image, ImageDraw

from lerobot_agpd.replay.episode import Array, EpisodeRecord
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.replay.stored import StoredEpisode
from lerobot_agpd.studies.animation import BACKGROUND, FAILURE, SUCCESS, TEXT, label_font
from lerobot_agpd.studies.recording import rendered_frame

COLUMNS = 8
WIDTH, CAPTION, GAP, BORDER = 130, 32, 6, 3  # pixels


@dataclass(frozen=True)
class Thumbnail:
    """One episode on the sheet.

    Attributes:
        record: facts about it.
        frame: (H, W, 3) uint8: the last one of a kept episode, the first one of a dropped one, of which no more is stored.
    """

    record: EpisodeRecord
    frame: Array


def draw_contact_sheet(journal: EpisodeJournal, number: int, env: EnvConfig, limit: int, path: Path) -> None:
    """Draw the episodes of a round, kept ones first.

    The simulation is set up anew from the recorded seeds, and the recorded actions are executed again: nothing of this
    was rendered while the round was collected.

    Args:
        journal: the run's episodes.
        number: of the round.
        env: where they were collected.
        limit: episodes at most, spread evenly over the kept and over the dropped ones.
        path: of the PNG.
    """
    records = sorted(journal.records(number), key=lambda record: not record.kept)
    chosen = [
        records[row]
        for row in np.unique(np.linspace(0, len(records) - 1, min(limit, len(records)), dtype=int))
    ]
    kept = {episode.record.number: episode for episode in journal.kept(number)}
    tasks = make_env(env, n_envs=1)
    try:
        simulation = next(iter(next(iter(tasks.values())).values()))
        thumbnails = list(_thumbnails(simulation, chosen, kept))
    finally:
        close_envs(tasks)
    _sheet(thumbnails).save(path)


def _thumbnails(
    env: gym.vector.VectorEnv, records: Sequence[EpisodeRecord], kept: dict[int, StoredEpisode]
) -> Iterator[Thumbnail]:
    for record in records:
        seed: Any = [record.seed]
        env.reset(seed=seed, options={NEW_ROLLOUT_OPTION: True})
        if record.kept:
            actions = np.asarray(kept[record.number].column(ACTION))
            for action in actions[:-1]:  # behind the last one the next episode begins
                env.step(action[None])
        yield Thumbnail(record, rendered_frame(env))


def _sheet(thumbnails: Sequence[Thumbnail]) -> Image.Image:
    cells = [_cell(thumbnail) for thumbnail in thumbnails]
    n_columns = min(COLUMNS, len(cells))
    n_rows = -(-len(cells) // n_columns)
    width, height = max(cell.width for cell in cells) + GAP, max(cell.height for cell in cells) + GAP
    sheet = Image.new("RGB", (n_columns * width + GAP, n_rows * height + GAP), BACKGROUND)
    for position, cell in enumerate(cells):
        row, column = divmod(position, n_columns)
        sheet.paste(cell, (GAP + column * width, GAP + row * height))
    return sheet


def _cell(thumbnail: Thumbnail) -> Image.Image:
    record = thumbnail.record
    frame = Image.fromarray(thumbnail.frame)
    frame = frame.resize((WIDTH, round(frame.height * WIDTH / frame.width)), Image.Resampling.LANCZOS)
    cell = Image.new("RGB", (WIDTH, frame.height + CAPTION), BACKGROUND)
    cell.paste(frame, (0, 0))
    draw = ImageDraw.Draw(cell)
    color = SUCCESS if record.kept else FAILURE
    draw.rectangle((0, 0, WIDTH - 1, frame.height - 1), outline=color, width=BORDER)
    who = "teacher alone" if record.strength == 0 else f"strength {record.strength:.2g}"
    lines = (f"{'kept' if record.kept else 'dropped'}, {record.length} steps", who)
    for row, line in enumerate(lines):
        draw.text((2, frame.height + 2 + 14 * row), line, fill=TEXT, font=label_font(11))
    return cell
