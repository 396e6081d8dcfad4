"""What a run must remember across a resume, and the folder of its collected episodes."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, field, fields
from datetime import datetime
from pathlib import Path
from typing import Any

from accelerate.utils import broadcast_object_list

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.files import read_json
from lerobot_agpd.flag_checks import require
from lerobot_agpd.run import RunInfo

logger = logging.getLogger(__name__)

STATE_FILE = "agpd_state.json"
REPLAY_FOLDER = "agpd"


@dataclass
class Progress:
    """Counters saved with every checkpoint; guidance scale and statistics of rounds are in the journal.

    Attributes:
        step: training steps, counted as `--steps` counts them.
        rounds: collection rounds in T.
        replay_root: folder of the collected episodes.
        seen_episodes: demonstrations that the loader has delivered.
        reference_frames: frames of T at which the adversary has the teacher's chunks, by the rounds that T held then.
        checkpoint: folder that the counters were read from; None in a new run.
    """

    step: int = 0
    rounds: int = 0
    replay_root: str | None = None
    seen_episodes: list[int] = field(default_factory=list)
    reference_frames: list[list[int]] = field(default_factory=list)
    checkpoint: Path | None = None

    @classmethod
    def restore(cls, config: StudentConfig, run: RunInfo) -> Progress:
        """The counters of the checkpoint that a run resumes; fresh ones otherwise.

        Raises:
            FileNotFoundError: if the checkpoint of a resumed run has none.
            ValueError: if they are damaged or were written by another version.
        """
        return cls.read(config.pretrained_path) if run.resume and config.pretrained_path else cls()

    @classmethod
    def read(cls, checkpoint: Path | str) -> Progress:
        """The counters of a checkpoint; raises as `restore` does."""
        path = Path(checkpoint) / STATE_FILE
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} is missing, so this run cannot be resumed; start a new one from the checkpoint with "
                "--policy.path instead"
            )
        content: dict[str, Any] = read_json(path, "continue from an earlier checkpoint (--config_path)")
        saved = {entry.name for entry in fields(cls)} - {"checkpoint"}
        if set(content) != saved:
            raise ValueError(
                f"{path} was written by another version of lerobot_policy_agpd: it holds {sorted(content)}, this version "
                f"writes {sorted(saved)}. Resume with that version, or start a new run from the checkpoint with --policy.path"
            )
        return cls(**content, checkpoint=Path(checkpoint))

    def save(self, folder: Path) -> None:
        """Write the counters into a checkpoint's folder."""
        content = {
            entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "checkpoint"
        }
        (folder / STATE_FILE).write_text(json.dumps(content) + "\n")


def find_replay_root(config: StudentConfig, run: RunInfo, progress: Progress) -> Path:
    """Folder of the collected episodes, the same on every process.

    `--policy.replay.root` if given. A resumed run has it beside its checkpoint, wherever the two were moved; if its own
    output folder is another one, the folder is noted in `config`, so that the checkpoints to come know it. Otherwise
    `<output_dir>/agpd`; without a run, a new folder.

    Raises:
        FlagError: if the checkpoint is a copy that left its episodes behind.
    """
    if config.replay.root:
        return Path(config.replay.root)
    parent = run.output_dir
    if progress.checkpoint is not None:
        # <output_dir>/checkpoints/<step>/pretrained_model
        checkpoint = progress.checkpoint.resolve()
        run_folder = [*checkpoint.parents][:3][-1]
        if parent is not None and parent.resolve() != run_folder:
            logger.warning(
                "the run of %s goes on, and its next checkpoints go to %s; pass --output_dir=%s to keep them together",
                checkpoint,
                parent,
                run_folder,
            )
        beside, recorded = run_folder / REPLAY_FOLDER, progress.replay_root
        if beside.is_dir():
            if parent is None or parent.resolve() != run_folder:
                config.replay.root = str(beside)
            return beside
        require(
            recorded is None or not Path(recorded).is_dir(),
            f"the collected episodes of {checkpoint} are not beside it (there is no {beside}). The folder {recorded} "
            "belongs to the run that it was copied from: copy it there, or pass "
            f"--policy.replay.root={recorded} to use it, and to write to it",
        )
    if parent is None:
        parent = Path("outputs/agpd") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
        logger.info("collected episodes go to %s", parent / REPLAY_FOLDER)
    (parent,) = broadcast_object_list([parent])  # LeRobot's default is a timestamp made by every process
    return parent / REPLAY_FOLDER
