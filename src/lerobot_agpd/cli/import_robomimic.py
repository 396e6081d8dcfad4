"""`lerobot-agpd-import-robomimic file.hdf5 --root=...`: robomimic's demonstrations as a LeRobotDataset.

Beside the dataset, `meta/robomimic.json` says where every episode comes from, and `meta/robomimic.hdf5` has the
recordings in full precision with simulator states and models, for replaying them.
"""

import hashlib
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datasets import disable_progress_bars
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.cli.progress import episode_bar
from lerobot_agpd.dataset_writer import DatasetWriter
from lerobot_agpd.envs.robomimic_columns import DONES, REWARDS, RobomimicColumns, cameras_of, task_of
from lerobot_agpd.envs.robomimic_hdf5 import RobomimicFile, sha256
from lerobot_agpd.envs.robomimic_recordings import RECORDINGS_PATH, copy_recordings
from lerobot_agpd.envs.robomimic_robot import check_robot
from lerobot_agpd.flag_checks import require

logger = logging.getLogger(__name__)

REPORT_PATH = Path("meta/robomimic.json")


@dataclass
class ImportRobomimicConfig:
    """Options of `lerobot-agpd-import-robomimic`; `--source=` may be left out before the first word."""

    # robomimic's file with observations, such as low_dim_v15.hdf5.
    source: Path
    # Folder of the new dataset; must not exist.
    root: Path
    # Name of the new dataset.
    repo_id: str = "local/robomimic"
    # Episodes to keep, e.g. "[0,1]", demo_0 first; default: all.
    episodes: list[int] | None = None
    # Keep the demonstrations of this mask of the file, e.g. 20_percent.
    filter_key: str | None = None
    # Import camera images, and not the objects' state.
    images: bool = False
    # Cameras to import with --images=true, e.g. "[agentview]"; default: all of the file.
    cameras: list[str] | None = None
    # Import the objects' state; default: unless --images=true.
    environment_state: bool | None = None
    # Store images as video, smaller but lossy; default: PNG.
    video: bool = False
    # A killed import goes on, and repeats at most this many episodes.
    episodes_per_shard: int = 20
    # Upload the dataset when it is done.
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            FlagError: if an option is impossible.
        """
        require(self.source.is_file(), f"--source={self.source} is not a file; expected robomimic's .hdf5")
        require(not self.root.exists(), f"--root={self.root} already exists; choose a new folder")
        if self.episodes is not None:
            require(self.filter_key is None, "give either --episodes or --filter_key, not both")
            require(
                0 < len(self.episodes) == len(set(self.episodes)),
                f"--episodes={self.episodes} must name at least one episode, and none twice",
            )
        require(self.images or not (self.cameras or self.video), "--cameras and --video need --images=true")
        require(
            self.episodes_per_shard >= 1,
            f"--episodes_per_shard must be at least 1, got {self.episodes_per_shard}",
        )


def columns_of(config: ImportRobomimicConfig, file: RobomimicFile) -> RobomimicColumns:
    """Choose and check what to import from a file.

    Raises:
        ValueError: if the file is of another task, or lacks what was requested.
    """
    demos = file.select(config.episodes, config.filter_key)
    file.observation_shapes(demos[0])  # raises first for a file without observations
    task = task_of(file)
    check_robot(file, task)
    is_in_file = {key: any(key in file.data[demo] for demo in demos) for key in (REWARDS, DONES)}
    if lacking := [key for key, present in is_in_file.items() if not present]:
        logger.warning("%s has no %s: imported without", file.path, " and no ".join(lacking))
    columns = RobomimicColumns(
        file=file,
        demos=demos,
        task=task,
        cameras=tuple(cameras_of(file, demos[0], config.cameras)) if config.images else (),
        # A policy of images should not see the objects' state by accident.
        has_environment_state=not config.images
        if config.environment_state is None
        else config.environment_state,
        has_rewards=is_in_file[REWARDS],
        has_dones=is_in_file[DONES],
        image_dtype="video" if config.video else "image",
    )
    columns.check()
    return columns


def provenance(file: RobomimicFile, demos: Sequence[str], digest: str) -> dict[str, Any]:
    """Contents of `meta/robomimic.json`.

    Args:
        file: the source.
        demos: names of the imported demonstrations, in the order of the dataset's episodes.
        digest: SHA-256 of the file.
    """
    operators = [*file.operators, None]  # -1 is none of them
    models = {demo: file.model_xml(demo) for demo in demos}
    return {
        "source": {"file": file.path.name, "sha256": digest, "bytes": file.path.stat().st_size},
        "env_args": file.env_args,
        "robosuite_version": file.env_args.get("env_version"),
        "operators": file.operators,
        "masks": file.masks,
        "recordings": str(RECORDINGS_PATH),
        "episodes": [
            {
                "demo": demo,
                "length": file.length(demo),
                "operator": operators[file.operator_of(demo)],
                "model_sha256": model and hashlib.sha256(model.encode()).hexdigest(),
            }
            for demo, model in models.items()
        ],
    }


def import_robomimic(config: ImportRobomimicConfig) -> LeRobotDataset:
    """Write the dataset, or go on where a killed import of the same file and options stopped.

    Raises:
        ValueError: if the file is damaged, not robomimic's, of an unknown task or lacks what was requested.
        FileExistsError: if `<root>.partial` holds something else.
        ModuleNotFoundError: if h5py is not installed.
    """
    with RobomimicFile(config.source) as file:
        columns = columns_of(config, file)
        demos, digest = columns.demos, sha256(config.source)
        warn_about_replays(file, demos)

        def add_provenance(folder: Path) -> None:
            copy_recordings(file, demos, folder / RECORDINGS_PATH)
            report = provenance(file, demos, digest)
            (folder / REPORT_PATH).write_text(json.dumps(report, indent=2) + "\n")

        writer = DatasetWriter(
            config.root,
            config.repo_id,
            file.fps,
            columns.features,
            use_videos=config.video,
            plan={"source": digest, "demos": demos},
            episodes_per_shard=config.episodes_per_shard,
        )
        with episode_bar("episodes", len(demos)) as advance:
            return writer.write(map(columns.frames, demos), lambda: advance(1), add_provenance)


def warn_about_replays(file: RobomimicFile, demos: Sequence[str]) -> None:
    """Warn about what keeps the recorded actions from being replayed in the environment type."""
    if not file.is_v15:
        logger.warning(
            "%s was recorded with robosuite %s: the objects' state is put into the order and signs of 1.5, but "
            "actions replayed in 1.5 need not lead where they led",
            file.path,
            file.env_args.get("env_version", "before 1.5"),
        )
    if lacking := [demo for demo in demos if not file.is_replayable(demo)]:
        logger.warning("%s lacks states or model_file of %s: they cannot be replayed", file.path, lacking)


@entry_point("lerobot-agpd-import-robomimic")
def run(config: ImportRobomimicConfig) -> None:
    """Import, report and optionally upload."""
    disable_progress_bars()  # one bar of the datasets library per episode would tear ours apart
    dataset = import_robomimic(config)
    logger.info("%d episodes, %d frames in %s", dataset.num_episodes, dataset.num_frames, config.root)
    if config.push_to_hub:
        dataset.push_to_hub()


def main() -> None:
    """Console entry point; a first word is `--source=`, since draccus knows no positional arguments."""
    if sys.argv[1:] and not sys.argv[1].startswith("-"):
        sys.argv[1] = f"--source={sys.argv[1]}"
    run()


if __name__ == "__main__":
    main()
