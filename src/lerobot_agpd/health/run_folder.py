"""Examine the folder of a run."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from lerobot_agpd.health.checkpoints import Checkpoint, examine_checkpoints
from lerobot_agpd.health.dataset import examine_dataset
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
