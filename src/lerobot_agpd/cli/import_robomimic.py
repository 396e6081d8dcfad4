"""`lerobot-agpd-import-robomimic file.hdf5 --root=...`: robomimic's demonstrations as a LeRobotDataset.

What the dataset cannot hold lies beside it: `meta/robomimic.json` says where every episode comes from,
`meta/robomimic.hdf5` has the recordings in full precision with simulator states and models, for replaying them.
"""

import json
import logging
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
from datasets import disable_progress_bars
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli.command import command
from lerobot_agpd.cli.progress import episode_bar
from lerobot_agpd.envs.robomimic_columns import RobomimicColumns, cameras_of, task_of
from lerobot_agpd.envs.robomimic_hdf5 import RobomimicFile, sha256
from lerobot_agpd.envs.robomimic_recordings import RECORDINGS_PATH, copy_recordings
from lerobot_agpd.envs.shards import Frame, ShardedWriter

logger = logging.getLogger(__name__)

REPORT_PATH = Path("meta/robomimic.json")


@dataclass
class ImportRobomimicConfig:
    """Options of `lerobot-agpd-import-robomimic`; `--source=` may be left out before the first word."""

    source: Path  # robomimic's file with observations, such as low_dim_v15.hdf5
    root: Path  # folder of the new dataset; must not exist
    repo_id: str = "local/robomimic"  # name of the new dataset
    episodes: list[int] | None = None  # which to keep, e.g. "[0,1]", demo_0 first; default: all
    filter_key: str | None = None  # keep the demonstrations of this mask of the file, e.g. 20_percent
    images: bool = False  # import camera images, and not the objects' state
    cameras: list[str] | None = None  # with --images: which, e.g. "[agentview]"; default: all of the file
    environment_state: bool | None = None  # import the objects' state; default: unless --images=true
    video: bool = False  # store images as video, smaller but lossy; default: PNG
    episodes_per_shard: int = 20  # a killed import goes on, and repeats at most this many episodes
    push_to_hub: bool = False  # upload the dataset when it is done

    def __post_init__(self) -> None:
        if not self.source.is_file():
            raise FileNotFoundError(f"--source={self.source} is not a file; expected robomimic's .hdf5")
        if self.root.exists():
            raise FileExistsError(f"--root={self.root} already exists; choose a new folder")
        if self.episodes is not None and self.filter_key is not None:
            raise ValueError("give either --episodes or --filter_key, not both")
        if self.episodes is not None and (not self.episodes or len(set(self.episodes)) < len(self.episodes)):
            raise ValueError(f"--episodes={self.episodes} must name at least one episode, and none twice")
        if not self.images and (self.cameras or self.video):
            raise ValueError("--cameras and --video need --images=true")
        if self.episodes_per_shard < 1:
            raise ValueError(f"--episodes_per_shard must be at least 1, got {self.episodes_per_shard}")

    @property
    def has_environment_state(self) -> bool:
        """Whether the objects' state is imported: a policy of images should not see it by accident."""
        return not self.images if self.environment_state is None else self.environment_state


def dataset_columns(config: ImportRobomimicConfig, file: RobomimicFile, demo: str) -> RobomimicColumns:
    """What to import from a file; `demo` tells its cameras.

    Raises:
        ValueError: if the file is of another task, or lacks observations or a camera.
    """
    file.observation_shapes(demo)  # a file without observations should say so first
    return RobomimicColumns(
        file=file,
        task=task_of(file),
        cameras=tuple(cameras_of(file, demo, config.cameras)) if config.images else (),
        has_environment_state=config.has_environment_state,
        image_dtype="video" if config.video else "image",
    )


def provenance(file: RobomimicFile, demos: Sequence[str], digest: str) -> dict[str, Any]:
    """Contents of `meta/robomimic.json`.

    Args:
        file: the source.
        demos: names of the imported demonstrations, in the order of the dataset's episodes.
        digest: SHA-256 of the file.
    """
    operators = [*file.operators, None]  # -1 is none of them
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
                "model_sha256": file.model_sha256(demo),
            }
            for demo in demos
        ],
    }


def import_robomimic(config: ImportRobomimicConfig) -> LeRobotDataset:
    """Write the dataset, or go on where a killed import of the same file and options stopped.

    Raises:
        ValueError: if the file is damaged, not robomimic's, of an unknown task or without what was asked for.
        FileExistsError: if `<root>.partial` holds something else.
        ModuleNotFoundError: if h5py is not installed.
    """
    with RobomimicFile(config.source) as file:
        demos = file.select(config.episodes, config.filter_key)
        columns = dataset_columns(config, file, demos[0])
        file.check(demos, columns.shapes(demos[0]))
        warn_about_replays(file, demos)
        features, digest = columns.features(demos[0]), sha256(config.source)
        plan = {
            "source": digest,
            "repo_id": config.repo_id,
            "demos": demos,
            "features": {key: f"{value['dtype']} {list(value['shape'])}" for key, value in features.items()},
            "episodes_per_shard": config.episodes_per_shard,
        }

        def create(root: Path) -> LeRobotDataset:
            return LeRobotDataset.create(
                config.repo_id, fps=file.fps, features=features, root=root, use_videos=config.video
            )

        def frames(episode: int) -> Iterator[Frame]:
            values = columns.read(demos[episode])
            for step in range(file.length(demos[episode])):
                frame = {key: column[step] for key, column in values.items()}
                yield {**frame, "task": columns.task.description}

        def add_provenance(root: Path) -> None:
            copy_recordings(file, demos, root / RECORDINGS_PATH)
            report = provenance(file, demos, digest)
            (root / REPORT_PATH).write_text(json.dumps(report, indent=2) + "\n")

        writer = ShardedWriter(config.root, plan)
        with episode_bar("episodes", len(demos)) as advance:
            writer.write(len(demos), config.episodes_per_shard, create, frames, advance)
        return writer.merge(config.repo_id, add_provenance)


def warn_about_replays(file: RobomimicFile, demos: Sequence[str]) -> None:
    """Say what will keep the recorded actions from being replayed in the environment type."""
    if not file.is_v15:
        logger.warning(
            "%s was recorded with robosuite %s: the objects' state is put into the order and signs of 1.5, but "
            "actions replayed in 1.5 need not lead where they led",
            file.path,
            file.env_args.get("env_version", "before 1.5"),
        )
    if lacking := [demo for demo in demos if not file.is_replayable(demo)]:
        logger.warning("%s lacks states or model_file of %s: they cannot be replayed", file.path, lacking)


@draccus.wrap()
def run(config: ImportRobomimicConfig) -> None:
    """Import, report and optionally upload."""
    dataset = import_robomimic(config)
    logger.info("%d episodes, %d frames in %s", dataset.num_episodes, dataset.num_frames, config.root)
    if config.push_to_hub:
        dataset.push_to_hub()


def with_source_flag(arguments: Sequence[str]) -> list[str]:
    """Turn a first word into `--source=`, since draccus knows no positional arguments."""
    if arguments and not arguments[0].startswith("-"):
        return [f"--source={arguments[0]}", *arguments[1:]]
    return list(arguments)


def main() -> None:
    """Console entry point."""
    disable_progress_bars()  # one bar of the datasets library per episode would tear ours apart
    with command("lerobot-agpd-import-robomimic"):
        run(draccus.parse(ImportRobomimicConfig, args=with_source_flag(sys.argv[1:])))


if __name__ == "__main__":
    main()
