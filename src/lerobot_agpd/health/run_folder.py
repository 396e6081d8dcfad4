"""Examine the folder of a run, and a dataset of demonstrations."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.utils import DATA_DIR, DEFAULT_TASKS_PATH, EPISODES_DIR, INFO_PATH, STATS_PATH

from lerobot_agpd.files import read_json
from lerobot_agpd.health.checkpoints import Checkpoint, examine_checkpoints
from lerobot_agpd.health.episodes import examine_episodes
from lerobot_agpd.health.finding import Finding, Severity
from lerobot_agpd.progress import REPLAY_FOLDER

LITTLE_SPACE = 2**30
"""Bytes of free disk below which a warning is due: a checkpoint or a round may not fit."""


def examine_run(run: Path) -> list[Finding]:
    """Findings about the output folder of a `lerobot-train` run: checkpoints, collected episodes, disk."""
    findings, checkpoint = examine_checkpoints(run)
    counters = checkpoint.counters if checkpoint else {}
    replay, found = _replay_folder(run, checkpoint)
    findings += found
    rounds_used = int(counters.get("rounds") or 0)
    if replay.is_dir():
        findings += examine_episodes(replay, rounds_used)
    elif rounds_used:
        text = f"{replay} is missing; the newest checkpoint has used {rounds_used} rounds of it"
        remedy = "restore it, or name the folder that holds them: --policy.replay.root"
        findings.append(Finding(Severity.BROKEN, "episodes", text, remedy))
    dataset = checkpoint and (checkpoint.train_config.get("dataset") or {}).get("root")
    if dataset and Path(dataset).is_dir():
        findings += examine_dataset(Path(dataset))
    return [*findings, *_disk(run)]


def _replay_folder(run: Path, checkpoint: Checkpoint | None) -> tuple[Path, list[Finding]]:
    """Folder of the collected episodes, looked for as a resumed run does, and a warning if it is not the run's own."""
    own = run / REPLAY_FOLDER
    if checkpoint is None:
        return own, []
    chosen = ((checkpoint.train_config.get("policy") or {}).get("replay") or {}).get("root")
    if chosen:  # --policy.replay.root
        return Path(chosen), []
    recorded = checkpoint.counters.get("replay_root")
    if own.is_dir() or not recorded or not Path(recorded).is_dir():
        return own, []
    text = f"{own} is missing; the run goes on with the episodes in {recorded}"
    remedy = "if that is another run's folder, as after copying one: copy its agpd folder, too"
    return Path(recorded), [Finding(Severity.WARNING, "episodes", text, remedy)]


def _disk(folder: Path) -> Iterator[Finding]:
    free = shutil.disk_usage(folder).free
    text = f"{free / 2**30:.1f} GiB are free on the disk of {folder}"
    if free < LITTLE_SPACE:
        yield Finding(Severity.WARNING, "disk", text, "make room, before a checkpoint cannot be written")
    else:
        yield Finding(Severity.OK, "disk", text)


def examine_dataset(root: Path) -> list[Finding]:
    """Findings about a LeRobotDataset on this machine: whether its files can be read, and agree."""
    area, remedy = "demonstrations", "restore the file, or record or download the dataset again"
    findings: list[Finding] = []
    info: dict[str, Any] = {}
    for name in (INFO_PATH, STATS_PATH):
        try:
            content = read_json(root / name)
        except FileNotFoundError:
            findings.append(Finding(Severity.BROKEN, area, f"{root / name} is missing", remedy))
        except ValueError as error:
            findings.append(Finding.of(Severity.BROKEN, area, error, remedy))
        else:
            info = content if name == INFO_PATH else info
    for folder, key in ((EPISODES_DIR, "total_episodes"), (DATA_DIR, "total_frames")):
        paths = sorted((root / folder).glob("*/*.parquet"))
        n_rows, found = _parquet_rows(paths, remedy)
        findings += found
        if info and not found and n_rows != info.get(key):
            text = f"{root / folder} holds {n_rows} rows, {INFO_PATH} says {key} = {info.get(key)}"
            findings.append(Finding(Severity.BROKEN, area, text, remedy))
    tasks = root / DEFAULT_TASKS_PATH
    findings += _parquet_rows([tasks], remedy)[1]
    if not findings:
        text = f"{root}: {info['total_episodes']} episodes, {info['total_frames']} frames can be read"
        findings.append(Finding(Severity.OK, area, text))
    return findings


def _parquet_rows(paths: list[Path], remedy: str) -> tuple[int, list[Finding]]:
    """Rows of parquet files, all columns of which are read, and what is wrong with them."""
    n_rows, findings = 0, []
    for path in paths:
        try:
            table = pq.ParquetFile(path).read()
        except (pa.ArrowException, OSError) as error:
            text = f"{path} cannot be read ({' '.join(str(error).split())})"
            findings.append(Finding(Severity.BROKEN, "demonstrations", text, remedy))
            continue
        n_rows += table.num_rows
        bad = next((name for name in table.column_names if _has_nan(table[name])), None)
        if bad:
            text = f"{path} holds numbers in '{bad}' that are not finite"
            remove = "remove the episode: lerobot-edit-dataset --operation.type=delete_episodes"
            findings.append(Finding(Severity.BROKEN, "demonstrations", text, remove))
    return n_rows, findings


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
