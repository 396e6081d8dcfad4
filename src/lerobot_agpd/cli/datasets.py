"""What the commands that write a LeRobotDataset have in common: where it goes, a progress bar, the upload."""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from datasets import disable_progress_bars
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lerobot_agpd.dataset_writer import DatasetWriter, Frame

logger = logging.getLogger(__name__)


@dataclass(kw_only=True)
class NewDataset:
    """Where a command writes its dataset."""

    # Folder of the new dataset; must not exist.
    root: Path
    # Name of the new dataset.
    repo_id: str
    # Upload the dataset when it is done.
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        if self.root.exists():
            raise FileExistsError(f"--root={self.root} already exists; choose a new folder")


def write(
    writer: DatasetWriter,
    episodes: Iterable[Iterable[Frame]],
    n_episodes: int,
    add_files: Callable[[Path], None] = lambda folder: None,
) -> LeRobotDataset:
    """Write a dataset and show how many of its episodes are done; see `DatasetWriter.write`."""
    disable_progress_bars()  # one bar of the datasets library per episode would tear this one apart
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns) as progress:
        bar = progress.add_task("episodes", total=n_episodes)
        return writer.write(episodes, lambda: progress.advance(bar), add_files)


def finish(dataset: LeRobotDataset, push_to_hub: bool) -> None:
    """Say what a dataset holds, and upload it if it is to be."""
    logger.info("%d episodes, %d frames in %s", dataset.num_episodes, dataset.num_frames, dataset.root)
    if push_to_hub:
        dataset.push_to_hub()
        logger.info("uploaded to %s", dataset.repo_id)
