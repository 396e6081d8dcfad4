"""What a distillation must remember across a resume, and where its episodes live."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from lerobot_agpd.replay.config import ReplayConfig
from lerobot_agpd.run import RunInfo, broadcast

logger = logging.getLogger(__name__)

STATE_FILE = "agpd_state.json"
REPLAY_FOLDER = "agpd"


@dataclass
class DistillationState:
    """Counters saved with every checkpoint. Scale and round statistics live in the replay's manifest."""

    updates: int = 0
    rounds: int = 0
    replay_root: str | None = None
    seen_episodes: list[int] = field(default_factory=list)
    checkpoint: str | None = None

    @classmethod
    def restore(cls, config: Any, run: RunInfo) -> DistillationState:
        """The counters of the checkpoint that a run resumes; fresh ones otherwise.

        Raises:
            FileNotFoundError: if the checkpoint of a resumed run has none.
        """
        if not (run.resume and config.pretrained_path):
            return cls()
        path = Path(config.pretrained_path) / STATE_FILE
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} is missing, so this run cannot be resumed; start a new one from the checkpoint with "
                "--policy.path instead"
            )
        return cls(**{**json.loads(path.read_text()), "checkpoint": str(config.pretrained_path)})

    def save(self, folder: Path) -> None:
        """Write the counters into a checkpoint's folder."""
        entries = {key: value for key, value in asdict(self).items() if key != "checkpoint"}
        (folder / STATE_FILE).write_text(json.dumps(entries) + "\n")


def replay_root(config: ReplayConfig, run: RunInfo, state: DistillationState) -> Path:
    """Folder of the collected episodes.

    `--policy.replay.root` if given. A resumed run looks beside its checkpoint first, since runs get moved, then
    where it was. Otherwise `<output_dir>/agpd` if the output folder was named, else a new folder, chosen by
    rank 0.
    """
    if config.root:
        return Path(config.root)
    if state.checkpoint is not None:
        # <output_dir>/checkpoints/<step>/pretrained_model
        beside = Path(state.checkpoint).resolve().parents[2] / REPLAY_FOLDER
        if beside.is_dir():
            return beside
        if state.replay_root and Path(state.replay_root).is_dir():
            return Path(state.replay_root)
    if run.output_dir is not None:
        return run.output_dir / REPLAY_FOLDER
    chosen: str = broadcast(str(Path("outputs/agpd") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"))
    logger.info("no --output_dir was named: collected episodes go to %s", chosen)
    return Path(chosen)
