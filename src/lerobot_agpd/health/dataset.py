"""Examine a LeRobotDataset on this machine: whether its files can be read, agree, and hold numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.utils import DATA_DIR, DEFAULT_TASKS_PATH, EPISODES_DIR, INFO_PATH, STATS_PATH

from lerobot_agpd.files import read_json
from lerobot_agpd.health.finding import Finding, Severity

AREA = "demonstrations"
RESTORE = "restore the file, or record or download the dataset again"
REMOVE = "remove the episode: lerobot-edit-dataset --operation.type=delete_episodes"


def examine_dataset(root: Path) -> list[Finding]:
    """Findings about a dataset, all of which is read."""
    info, findings = _metadata(root)
    for folder, key in ((EPISODES_DIR, "total_episodes"), (DATA_DIR, "total_frames")):
        findings += _rows(root / folder, info.get(key), key, read=True)
    findings += _table(root / DEFAULT_TASKS_PATH, read=True)[1]
    if not findings:
        text = f"{root}: {info['total_episodes']} episodes, {info['total_frames']} frames can be read"
        findings.append(Finding(Severity.OK, AREA, text))
    return findings


def damage_of_dataset(root: Path) -> Finding | None:
    """The first thing wrong with a dataset's files, of whose tables only the ends are read; None if nothing."""
    info, findings = _metadata(root)
    for folder, key in ((EPISODES_DIR, "total_episodes"), (DATA_DIR, "total_frames")):
        findings += _rows(root / folder, info.get(key), key, read=False)
    findings += _table(root / DEFAULT_TASKS_PATH, read=False)[1]
    return next(iter(findings), None)


def _metadata(root: Path) -> tuple[dict[str, Any], list[Finding]]:
    """The content of info.json, and what is wrong with the JSON files."""
    info: dict[str, Any] = {}
    findings: list[Finding] = []
    for name in (INFO_PATH, STATS_PATH):
        try:
            content = read_json(root / name)
        except FileNotFoundError:
            findings.append(Finding(Severity.BROKEN, AREA, f"{root / name} is missing", RESTORE))
        except ValueError as error:
            findings.append(Finding.of(Severity.BROKEN, AREA, error, RESTORE))
        else:
            info = content if name == INFO_PATH else info
    return info, findings


def _rows(folder: Path, expected: int | None, key: str, read: bool) -> list[Finding]:
    """What is wrong with the parquet files of a folder, whose rows info.json counts."""
    tables = [_table(path, read) for path in sorted(folder.glob("*/*.parquet"))]
    findings = [finding for _, found in tables for finding in found]
    n_rows = sum(rows for rows, _ in tables)
    if expected is not None and not findings and n_rows != expected:
        text = f"{folder} holds {n_rows} rows, {INFO_PATH} says {key} = {expected}"
        findings.append(Finding(Severity.BROKEN, AREA, text, RESTORE))
    return findings


def _table(path: Path, read: bool) -> tuple[int, list[Finding]]:
    """Rows of a parquet file, and what is wrong with it.

    Args:
        path: of the file.
        read: whether all of it is read, or its end alone, where the number of rows is.
    """
    try:
        file = pq.ParquetFile(path)
        table = file.read() if read else None
    except (pa.ArrowException, OSError) as error:
        text = f"{path} cannot be read ({' '.join(str(error).split())})"
        return 0, [Finding(Severity.BROKEN, AREA, text, RESTORE)]
    bad = next((name for name in table.column_names if _has_nan(table[name])), None) if table else None
    if bad:
        text = f"{path} holds numbers in '{bad}' that are not finite"
        return file.metadata.num_rows, [Finding(Severity.BROKEN, AREA, text, REMOVE)]
    return file.metadata.num_rows, []


def _has_nan(column: pa.ChunkedArray) -> bool:
    """Whether a column of numbers, or of lists of numbers, holds NaN or infinite ones."""
    kind = column.type
    while pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    if not pa.types.is_floating(kind):
        return False
    values = column.combine_chunks()
    while not pa.types.is_floating(values.type):
        values = values.flatten()
    return not bool(np.isfinite(values.drop_null().to_numpy(zero_copy_only=False)).all())
