"""Examine the collected episodes of a run: every report, every index line, every kept episode's files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.utils import INFO_PATH

from lerobot_agpd.files import read_json
from lerobot_agpd.health.finding import Finding, Severity
from lerobot_agpd.replay.episode import Array, EpisodeRecord
from lerobot_agpd.replay.export import MERGED
from lerobot_agpd.replay.journal import REPORT, EpisodeJournal
from lerobot_agpd.replay.stored import StoredEpisode, camera_path
from lerobot_agpd.rollout.report import RoundReport, Tally

AREA = "episodes"

ANOTHER = "restore it, or start a new run with another --policy.replay.root"

ROUND = re.compile(r"round-(\d{5,})")


def examine_episodes(root: Path, rounds_used: int = 0) -> list[Finding]:
    """Findings about a folder of collected episodes.

    Args:
        root: `<output_dir>/agpd`.
        rounds_used: rounds that the newest checkpoint has used.
    """
    journal = EpisodeJournal(root)
    try:
        _ = journal.header
    except ValueError as error:
        return [Finding.of(Severity.BROKEN, AREA, error, ANOTHER)]
    numbers = _rounds(root)
    finished = [number for number in numbers if (journal.folder(number) / REPORT).exists()]
    findings = list(_order(journal, numbers, finished, rounds_used))
    n_kept, n_intact = 0, 0
    for number in numbers:
        found, kept = _examine_round(journal, number, number in finished)
        n_kept, n_intact = n_kept + kept, n_intact + (not found)
        findings += found
    text = f"{root}: {len(finished)} finished rounds, {n_kept} kept episodes; {n_intact} of {len(numbers)} rounds intact"
    return [
        *findings,
        Finding(Severity.OK, AREA, text),
        *_merged(root, n_kept),
        *_leftovers(journal, numbers),
    ]


def _rounds(root: Path) -> list[int]:
    return sorted(int(name[1]) for path in root.iterdir() if (name := ROUND.fullmatch(path.name)))


def _order(
    journal: EpisodeJournal, numbers: Sequence[int], finished: Sequence[int], rounds_used: int
) -> Iterator[Finding]:
    """Whether rounds are missing."""
    last = max(finished, default=-1)
    for number in range(last):
        if number not in numbers:
            yield Finding(Severity.BROKEN, AREA, f"{journal.folder(number)} is missing", ANOTHER)
        elif number not in finished:
            text = f"{journal.folder(number) / REPORT} is missing, and a later round is finished"
            yield Finding(Severity.BROKEN, AREA, text, ANOTHER)
    for number in numbers:
        if number > last:
            text = f"{journal.folder(number)} is not finished"
            yield Finding(
                Severity.NOTE, AREA, text, "nothing is lost: the run goes on with its other episodes"
            )
    if rounds_used > len(finished):
        yield Finding(
            Severity.BROKEN,
            AREA,
            f"the newest checkpoint has used {rounds_used} rounds, {journal.root} holds {len(finished)} finished ones",
            "restore them, or name the folder that holds them: --policy.replay.root",
        )


# ---- one round ----


def _examine_round(journal: EpisodeJournal, number: int, is_finished: bool) -> tuple[list[Finding], int]:
    """What is wrong with a round, and its number of kept episodes."""
    findings: list[Finding] = []
    try:
        records, episodes = journal.records(number), journal.kept(number)
    except ValueError as error:
        return [Finding.of(Severity.BROKEN, AREA, error)], 0
    if is_finished:
        findings += _report(journal.folder(number) / REPORT, records)
    for episode in episodes:
        findings += _episode(episode)
    return findings, len(episodes)


def _report(path: Path, records: Sequence[EpisodeRecord]) -> Iterator[Finding]:
    """Whether a report can be read and agrees with the index."""
    try:
        report = RoundReport.from_json(read_json(path))
    except (ValueError, KeyError, TypeError) as error:
        text = str(error) if str(path) in str(error) else f"{path} is damaged ({error!r})"
        remedy = "restore it; of the last round: delete it, and the resumed run finishes the round again"
        yield Finding.of(Severity.BROKEN, AREA, text, remedy)
        return
    tally = Tally.of(records)
    if tally != report.total:
        text = f"{path} counts {report.total.generated} episodes, {report.total.kept} of them kept; its index has {tally.generated} and {tally.kept}"
        remedy = "restore rank-*.jsonl beside it; the run goes on with what the index has"
        yield Finding(Severity.BROKEN, AREA, text, remedy)


def _episode(episode: StoredEpisode) -> Iterator[Finding]:
    """Whether the files of a kept episode are there, of its length, and hold numbers."""
    files = [episode.path, *(camera_path(episode.path, key) for key in episode.cameras)]
    index = episode.path.with_name(f"{episode.path.stem.rsplit('-', 1)[0]}.jsonl")
    remedy = (
        "restore it, or go on without the episode: delete the line with "
        f'"number": {episode.record.number} from {index}'
    )
    for path in files:
        problem = _rows_problem(path, len(episode))
        if problem:
            yield Finding(Severity.BROKEN, AREA, f"{path} {problem}", remedy)


def _rows_problem(path: Path, length: int) -> str | None:
    """What is wrong with a file of one row per step; None if nothing."""
    if not path.is_file():
        return "is missing"
    try:
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        return f"is damaged ({' '.join(str(error).split())})"
    if rows.ndim == 0 or len(rows) != length:
        return f"holds {0 if rows.ndim == 0 else len(rows)} steps instead of {length}"
    bad = next((name for name, values in _columns(rows) if not np.isfinite(values).all()), None)
    return f"holds numbers in '{bad}' that are not finite" if bad else None


def _columns(rows: Array) -> Iterator[tuple[str, Array]]:
    """Columns of floating-point numbers, by name; images have none."""
    for name in rows.dtype.names or ():
        if np.issubdtype(rows.dtype[name].base, np.floating):
            yield name, rows[name]


# ---- beside the rounds ----


def _merged(root: Path, n_kept: int) -> Iterator[Finding]:
    """Whether the merged dataset holds all kept episodes."""
    folder = root / MERGED
    if not folder.exists():
        return
    again = f"lerobot-agpd-merge --root={root}"
    try:
        info: dict[str, Any] = read_json(folder / INFO_PATH)
    except (ValueError, FileNotFoundError) as error:
        yield Finding.of(Severity.WARNING, AREA, error, again)
        return
    if info.get("total_episodes") != n_kept:
        text = f"{folder} holds {info.get('total_episodes')} episodes, {n_kept} are kept"
        yield Finding(Severity.NOTE, AREA, text, again)


def _leftovers(journal: EpisodeJournal, numbers: Sequence[int]) -> Iterator[Finding]:
    """Files of killed processes, and episodes that no index knows."""
    files = list(journal.root.glob("round-*/*.partial"))
    for number in numbers:
        try:
            kept = journal.kept(number)
        except ValueError:
            continue
        known = {
            path
            for entry in kept
            for path in (entry.path, *(camera_path(entry.path, key) for key in entry.cameras))
        }
        files += [path for path in journal.folder(number).glob("*.npy") if path not in known]
    if files:
        text = f"{len(files)} files that no index knows, such as {sorted(files)[0]}"
        yield Finding(Severity.NOTE, AREA, text, "a killed process has left them; no run needs them")
