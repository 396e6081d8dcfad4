"""Collected episodes on disk: every kept episode is written once and read from there.

    <root>/
        journal.json                              the demonstrations' features, and the run the episodes belong to
        round-00000/rank-0.jsonl                  index of process 0: one record per episode, in the order of their ends
        round-00000/rank-0-000012.npy             vectors of kept episode 12, one row per step
        round-00000/rank-0-000012.<camera>.npy    its frames of a camera, (T, H, W, C) uint8
        round-00000/report.json                   written last: its presence makes the round a finished one
        merged/                                   all kept episodes as a LeRobotDataset, see `export.py`

Files are complete once they have their name: they are written under another one, synced and renamed. An episode's
frames are on disk before its record is, so a process may be killed at any point and loses at most the episodes that
were running. Episodes are numbered over all processes, so a round goes on with any number of them. Reading changes
nothing, so another process may read while a run collects.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_agpd.files import (
    append_line,
    complete_lines,
    read_json,
    trim_incomplete_line,
    write_array,
    write_json,
)
from lerobot_agpd.replay.episode import Episode, EpisodeRecord
from lerobot_agpd.replay.stored import StoredEpisode, camera_path, split_columns

logger = logging.getLogger(__name__)

HEADER = "journal.json"
REPORT = "report.json"

FRAMES_NAME = re.compile(r"(?P<stem>rank-\d+-\d{6,})(\..+)?\.npy(?P<partial>\.partial)?")
"""Names of `_frames_path` and `camera_path`, and what they are called while they are written."""


class EpisodeJournal:
    """The collected episodes of a run under one root folder; any number of processes may append."""

    def __init__(self, root: Path):
        """Use `root`, which `begin` creates."""
        self.root = root
        self._header: dict[str, Any] | None = None

    # ---- the run ----

    @property
    def exists(self) -> bool:
        """Whether the journal was begun."""
        return (self.root / HEADER).exists()

    @property
    def header(self) -> dict[str, Any]:
        """The demonstrations' `fps`, `robot_type`, `features` and `task`, and the run's `identity`.

        Raises:
            ValueError: if the file is missing or damaged.
        """
        if self._header is None:
            path = self.root / HEADER
            if not path.exists():
                raise ValueError(f"{path} is missing: {self.root} is no folder of collected episodes")
            self._header = read_json(path, "restore it, or start a new run with another --policy.replay.root")
        return self._header

    def begin(
        self,
        demonstrations: LeRobotDatasetMetadata,
        identity: Mapping[str, Any],
        resume: bool = False,
    ) -> None:
        """Write down what the episodes have in common, or check that this is the run they belong to.

        One process calls it before any process appends.

        Args:
            demonstrations: metadata of the demonstrations, whose features a merged dataset takes over.
            identity: what the run's episodes depend on, such as the teacher and the environment.
            resume: whether the run continues a checkpoint, whose episodes are its own whatever has changed; changes
                are warned of.

        Raises:
            ValueError: if the folder holds episodes of another run.
        """
        if not self.exists:
            tasks = demonstrations.tasks
            content = {
                "fps": demonstrations.fps,
                "robot_type": demonstrations.robot_type,
                "task": "" if tasks is None else str(tasks.index[0]),
                "features": demonstrations.features,
                "identity": dict(identity),
            }
            self.root.mkdir(parents=True, exist_ok=True)
            write_json(self.root / HEADER, content, indent=2)
        self._check_identity(json.loads(json.dumps(dict(identity), default=str)), resume)

    def _check_identity(self, identity: Mapping[str, Any], resume: bool) -> None:
        recorded = self.header["identity"]
        differing = [
            f"{key} {recorded.get(key)!r} instead of {identity.get(key)!r}"
            for key in sorted({*recorded, *identity})
            if recorded.get(key) != identity.get(key)
        ]
        if differing and resume:
            logger.warning(
                "the episodes in %s were collected with other settings (%s); the next ones follow the new settings",
                self.root,
                "; ".join(differing),
            )
        elif differing:
            raise ValueError(
                f"{self.root} holds the episodes of another run ({'; '.join(differing)}); pass another "
                "--policy.replay.root, or continue that run with --resume=true"
            )

    # ---- writing ----

    def append(self, round_number: int, rank: int, episode: Episode, record: EpisodeRecord) -> None:
        """Write an episode of a round: its frames if it is kept, then its record."""
        folder = self.folder(round_number)
        folder.mkdir(parents=True, exist_ok=True)
        vectors, images = split_columns(episode.columns)
        if record.kept:
            path = _frames_path(folder, rank, record.number)
            write_array(path, vectors)
            for key, values in images.items():
                write_array(camera_path(path, key), values)
        entry = {**record.to_json(), "task": episode.task, "cameras": sorted(images)}
        append_line(_index_path(folder, rank), json.dumps(entry))

    def finish(self, round_number: int, report: Mapping[str, Any]) -> None:
        """Make a round a finished one; called by one process after all have written their episodes.

        What a killed process has left half-written in the round's folder is removed.
        """
        folder = self.folder(round_number)
        folder.mkdir(parents=True, exist_ok=True)
        self._remove_leftovers(round_number)
        write_json(folder / REPORT, report, indent=2)

    def _remove_leftovers(self, round_number: int) -> None:
        """Remove incomplete lines, and frames that no record claims; names that are not ours are left alone."""
        folder = self.folder(round_number)
        for rank in _ranks(folder):
            trim_incomplete_line(_index_path(folder, rank))
        claimed = {
            _frames_path(folder, rank, entry["number"]).stem for rank, entry in self._kept(round_number)
        }
        for path in folder.iterdir():
            frames = FRAMES_NAME.fullmatch(path.name)
            if frames and (frames["partial"] or frames["stem"] not in claimed):
                path.unlink()

    # ---- reading ----

    def records(self, round_number: int) -> list[EpisodeRecord]:
        """Records of a round's episodes, of all processes, ordered by number.

        Raises:
            ValueError: if an index is damaged.
        """
        return [_record(entry) for _, entry in self._entries(round_number)]

    def kept(self, round_number: int) -> list[StoredEpisode]:
        """The kept episodes of a round, of all processes, ordered by number.

        Raises:
            ValueError: if an index is damaged.
        """
        folder = self.folder(round_number)
        return [
            StoredEpisode(
                record=_record(entry),
                task=entry["task"] or self.header["task"],
                path=_frames_path(folder, rank, entry["number"]),
                cameras=tuple(entry["cameras"]),
            )
            for rank, entry in self._kept(round_number)
        ]

    def stored(self) -> Iterator[tuple[int, StoredEpisode]]:
        """All kept episodes with their rounds, those of an unfinished round too."""
        for round_number in self.rounds():
            for episode in self.kept(round_number):
                yield round_number, episode

    def is_finished(self, round_number: int) -> bool:
        """Whether a round has its report."""
        return (self.folder(round_number) / REPORT).exists()

    def reports(self) -> list[dict[str, Any]]:
        """Reports of the finished rounds, in order.

        Raises:
            ValueError: if a round before the last finished one is not finished, or a report is damaged.
        """
        finished = [number for number in self.rounds() if self.is_finished(number)]
        missing = set(range(len(finished))) - set(finished)
        if missing:
            raise ValueError(
                f"{self.folder(min(missing))} should hold a finished round with a {REPORT}, since a later round is "
                "finished; restore it, or start a new run with another --policy.replay.root"
            )
        remedy = "restore it, or delete it to have the round finished again if no later round exists"
        return [read_json(self.folder(number) / REPORT, remedy) for number in finished]

    def rounds(self) -> list[int]:
        """Numbers of the rounds that were begun, in order."""
        if not self.root.exists():
            return []
        names = (re.fullmatch(r"round-(\d{5,})", path.name) for path in self.root.iterdir())
        return sorted(int(name[1]) for name in names if name)

    def folder(self, round_number: int) -> Path:
        """Folder of a round, whether it exists or not."""
        return self.root / f"round-{round_number:05d}"

    def _kept(self, round_number: int) -> list[tuple[int, dict[str, Any]]]:
        return [(rank, entry) for rank, entry in self._entries(round_number) if entry["kept"]]

    def _entries(self, round_number: int) -> list[tuple[int, dict[str, Any]]]:
        """Lines of a round's indices with their ranks, ordered by number."""
        folder = self.folder(round_number)
        found: dict[tuple[int, int], dict[str, Any]] = {}
        for rank in _ranks(folder):
            path = _index_path(folder, rank)
            for position, line in enumerate(complete_lines(path), start=1):
                entry = _parsed(line, path, position)
                found[entry["number"], rank] = entry
        return [(rank, found[number, rank]) for number, rank in sorted(found)]


def _ranks(folder: Path) -> list[int]:
    """Processes that have an index in a round's folder."""
    if not folder.exists():
        return []
    names = (re.fullmatch(r"rank-(\d+)\.jsonl", path.name) for path in folder.iterdir())
    return sorted(int(name[1]) for name in names if name)


def _parsed(line: str, path: Path, position: int) -> dict[str, Any]:
    try:
        entry = json.loads(line)
        _record(entry)
        _ = entry["task"], entry["cameras"]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"line {position} of {path} is not the record of an episode ({error!r}); delete the line: its episode is "
            "left out, or collected again if the round is not finished"
        ) from error
    return entry


def _record(entry: Mapping[str, Any]) -> EpisodeRecord:
    facts = {key: value for key, value in entry.items() if key not in ("task", "cameras")}
    return EpisodeRecord.from_json(facts)


def _index_path(folder: Path, rank: int) -> Path:
    return folder / f"rank-{rank}.jsonl"


def _frames_path(folder: Path, rank: int, number: int) -> Path:
    return folder / f"rank-{rank}-{number:06d}.npy"
