"""Collected episodes on disk: one finished LeRobotDataset per round and process, and a manifest.

    <root>/
        manifest.json                     the finished rounds, one report each
        round-000/round.json              the round's report, with a record of every generated episode
        round-000/rank-0/                 LeRobotDataset of the kept episodes (absent if none were kept)
        round-001.partial/spool-0.jsonl   an unfinished round: records of its episodes so far ...
        round-001.partial/spool-0/*.npz   ... and the arrays of the kept ones
        merged/                           all rounds as one LeRobotDataset, written when training ends

A LeRobotDataset that is killed before `finalize` cannot be read at all. Kept episodes are therefore first
written one by one; a round becomes a dataset when it is complete, in a folder that is renamed last.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.replay.episode import Episode, EpisodeRecord

logger = logging.getLogger(__name__)

MANIFEST = "manifest.json"
REPORT = "round.json"
MERGED = "merged"

WriteDataset = Callable[[Path, Iterator[Episode]], None]
"""Writes kept episodes, of which there is at least one, as a finalised LeRobotDataset into a new folder."""


@dataclass(frozen=True)
class Round:
    """A finished round: its number, its report and the folders of its datasets."""

    number: int
    report: Mapping[str, Any]
    datasets: tuple[Path, ...]


class Spool:
    """Episodes of one process's share of an unfinished round; survives being killed at any point."""

    def __init__(self, folder: Path, rank: int):
        """Open (or continue) the spool of `rank` in a partial round's folder."""
        self.arrays = folder / f"spool-{rank}"
        self.log = folder / f"spool-{rank}.jsonl"
        self.arrays.mkdir(parents=True, exist_ok=True)
        self.records = self._read()

    def add(self, episode: Episode, record: EpisodeRecord) -> None:
        """Remember an episode; the arrays of a kept one are on disk before its record is."""
        if record.kept:
            episode.save(self._path(record))
        with self.log.open("a") as log:
            log.write(json.dumps(record.to_json()) + "\n")
            log.flush()
            os.fsync(log.fileno())
        self.records[record.number] = record

    def kept(self) -> Iterator[Episode]:
        """The kept episodes in the order of their numbers, read one at a time: with cameras they are large."""
        for number in sorted(self.records):
            record = self.records[number]
            if record.kept:
                yield Episode.load(self._path(record), record)

    def _path(self, record: EpisodeRecord) -> Path:
        return self.arrays / f"episode-{record.number:06d}.npz"

    def _read(self) -> dict[int, EpisodeRecord]:
        if not self.log.exists():
            return {}
        *complete, rest = self.log.read_text().split("\n")
        if rest:  # the process died while writing this line: its episode is collected again
            logger.warning("dropping an incomplete record at the end of %s", self.log)
            self.log.write_text("".join(line + "\n" for line in complete))
        records = [EpisodeRecord.from_json(json.loads(line)) for line in complete]
        return {record.number: record for record in records}


class ReplayStore:
    """The collected rounds of a run under one root folder."""

    def __init__(self, root: Path):
        """Use `root`, which is created with the first round."""
        self.root = root

    # ---- reading ----

    def rounds(self) -> list[Round]:
        """The finished rounds in order.

        Raises:
            ValueError: if the manifest cannot be read or a listed dataset is missing.
        """
        listed = self._listed()
        found = sorted(path for path in self.root.glob("round-[0-9][0-9][0-9]") if (path / REPORT).exists())
        names = [*listed, *(path.name for path in found if path.name not in listed)]
        return [self._open(number, name) for number, name in enumerate(names)]

    def reports(self) -> list[dict[str, Any]]:
        """Reports of the finished rounds, without the single episodes."""
        return [
            {key: value for key, value in entry.report.items() if key != "episodes"}
            for entry in self.rounds()
        ]

    def _listed(self) -> list[str]:
        path = self.root / MANIFEST
        if not path.exists():
            return []
        try:
            return [str(entry["folder"]) for entry in json.loads(path.read_text())["rounds"]]
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path} is not a manifest of collected rounds ({error}); it can be deleted, finished rounds are "
                "found by their folders"
            ) from error

    def _open(self, number: int, name: str) -> Round:
        folder = self.root / name
        report = folder / REPORT
        if name != _name(number) or not report.exists():
            raise ValueError(
                f"{self.root} should hold the finished round {_name(number)} with a {REPORT}; found '{name}'. "
                "Was the folder (--policy.replay.root) moved or edited?"
            )
        return Round(
            number=number,
            report=json.loads(report.read_text()),
            datasets=tuple(sorted(path for path in folder.glob("rank-*") if path.is_dir())),
        )

    # ---- writing ----

    def spool(self, number: int, rank: int) -> Spool:
        """This process's part of the unfinished round `number`."""
        return Spool(self._partial(number), rank)

    def write_share(self, number: int, rank: int, write: WriteDataset) -> None:
        """Turn this process's spooled episodes into a dataset inside the unfinished round."""
        spool = self.spool(number, rank)
        dataset = self._partial(number) / f"rank-{rank}"
        shutil.rmtree(dataset, ignore_errors=True)
        if any(record.kept for record in spool.records.values()):
            write(dataset, spool.kept())

    def records(self, number: int, n_ranks: int) -> list[EpisodeRecord]:
        """Records of an unfinished round, of all processes."""
        spools = [self.spool(number, rank) for rank in range(n_ranks)]
        return [record for spool in spools for _, record in sorted(spool.records.items())]

    def finish(self, number: int, n_ranks: int, report: Mapping[str, Any]) -> None:
        """Make the round a finished one; called by one process after all have written their share."""
        partial, final = self._partial(number), self.root / _name(number)
        _write_json(partial / REPORT, report)
        partial.rename(final)
        self._write_manifest()
        for rank in range(n_ranks):  # the datasets hold it all now
            shutil.rmtree(final / f"spool-{rank}")
            (final / f"spool-{rank}.jsonl").unlink(missing_ok=True)

    def _write_manifest(self) -> None:
        rounds = self.rounds()
        summary = [
            {
                "folder": _name(round_.number),
                "datasets": [path.name for path in round_.datasets],
                **{key: value for key, value in round_.report.items() if key != "episodes"},
            }
            for round_ in rounds
        ]
        _write_json(self.root / MANIFEST, {"rounds": summary})

    def _partial(self, number: int) -> Path:
        return self.root / f"{_name(number)}.partial"

    # ---- merging ----

    def merge(self, repo_id: str | None = None) -> LeRobotDataset | None:
        """All rounds as one dataset in `<root>/merged`, named after the run by default; None if nothing was kept."""
        repo_id = repo_id or f"agpd/{self.root.resolve().parent.name}"
        roots = [path for round_ in self.rounds() for path in round_.datasets]
        if not roots:
            return None
        merged, partial = self.root / MERGED, self.root / f"{MERGED}.partial"
        shutil.rmtree(partial, ignore_errors=True)
        aggregate_datasets(
            repo_ids=[f"agpd/{root.parent.name}-{root.name}" for root in roots],
            aggr_repo_id=repo_id,
            roots=roots,
            aggr_root=partial,
        )
        shutil.rmtree(merged, ignore_errors=True)
        partial.rename(merged)
        return LeRobotDataset(repo_id, root=merged)


def _name(number: int) -> str:
    return f"round-{number:03d}"


def _write_json(path: Path, content: Any) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, indent=2) + "\n")
    partial.replace(path)
