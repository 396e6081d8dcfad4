"""`lerobot-agpd-import-pusht`: the human Push-T demonstrations of Diffusion Policy as a LeRobotDataset."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from datasets import disable_progress_bars
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DONE, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE, REWARD, SUCCESS

from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.cli.progress import episode_bar
from lerobot_agpd.dataset_writer import DatasetWriter, Frame, flag, image, vector
from lerobot_agpd.envs.base import DESCRIPTIONS
from lerobot_agpd.envs.pusht_recordings import IMAGE_SHAPE, Arrays, block_geometry, load_arrays
from lerobot_agpd.flag_checks import require

logger = logging.getLogger(__name__)

FPS = 10
TASK = DESCRIPTIONS["gym_pusht/PushT-v0"]
SUCCESS_COVERAGE = 0.95

Variant = Literal["keypoints", "state", "image", "image_keypoints"]


@dataclass
class ImportPushTConfig:
    """Options of `lerobot-agpd-import-pusht`."""

    # Diffusion Policy's replay buffer, a zarr folder or a zip of it, or its arrays in an .npz file.
    source: Path
    # Folder of the new dataset; must not exist.
    root: Path
    # Name of the new dataset.
    repo_id: str = "local/pusht_keypoints"
    # Observation beside the agent's position: the block's corners (keypoints) or pose (state), a 96x96 image, or image
    # and corners.
    variant: Variant = "keypoints"
    # Episodes to keep, e.g. "[0,1,2]"; default: all.
    episodes: list[int] | None = None
    # shorthand: keep episodes 0 to n-1.
    first_episodes: int | None = None
    # .npz file with the array img, if it is not in source.
    images: Path | None = None
    # Upload the dataset when it is done.
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            FlagError: if an option is impossible.
        """
        require(not self.root.exists(), f"--root={self.root} already exists; choose a new folder")
        for name, path in (("source", self.source), ("images", self.images)):
            require(path is None or path.exists(), f"--{name}={path} does not exist")
        require(
            self.episodes is None or self.first_episodes is None,
            "give either --episodes or --first_episodes, not both",
        )
        require(
            self.first_episodes is None or self.first_episodes >= 1,
            f"--first_episodes must be at least 1, got {self.first_episodes}",
        )
        if self.episodes is not None:
            require(
                min(self.episodes, default=-1) >= 0 and len(set(self.episodes)) == len(self.episodes),
                f"--episodes={self.episodes} must name at least one episode, counted from 0, and none twice",
            )


def dataset_features(variant: Variant) -> dict[str, dict[str, Any]]:
    """Features of lerobot/pusht_keypoints (keypoints) or lerobot/pusht (image); state has the block's pose instead."""
    beside_agent = {
        "keypoints": {OBS_ENV_STATE: vector(16)},
        "state": {OBS_ENV_STATE: vector(3)},
        "image": {OBS_IMAGE: image(IMAGE_SHAPE)},
        "image_keypoints": {OBS_IMAGE: image(IMAGE_SHAPE), OBS_ENV_STATE: vector(16)},
    }
    return {
        OBS_STATE: vector(2),
        **beside_agent[variant],
        ACTION: vector(2),
        REWARD: vector(1),
        SUCCESS: flag(),
        DONE: flag(),
    }


def episode_frames(arrays: Arrays, rows: slice, variant: Variant) -> Iterator[Frame]:
    """Yield the frames of one episode.

    Reward and success are those of the state that an action leads to, of the last state itself at the end; the
    recordings do not hold them.

    Args:
        arrays: see `load_arrays`.
        rows: of the episode.
        variant: what is observed beside the agent.
    """
    state = arrays["state"][rows]  # (T, 5)
    corners, coverage = block_geometry(state[:, 2:5])
    next_coverage = np.append(coverage[1:], coverage[-1])[:, None]  # (T, 1)
    columns = {
        OBS_STATE: state[:, :2].astype(np.float32),
        ACTION: arrays["action"][rows].astype(np.float32),
        REWARD: np.clip(next_coverage / SUCCESS_COVERAGE, 0, 1).astype(np.float32),
        SUCCESS: next_coverage > SUCCESS_COVERAGE,
        DONE: np.arange(1, len(state) + 1)[:, None] == len(state),
    }
    if "image" in variant:
        columns[OBS_IMAGE] = arrays["img"][rows]
    if variant != "image":
        columns[OBS_ENV_STATE] = state[:, 2:5].astype(np.float32) if variant == "state" else corners
    for step in range(len(state)):
        yield {**{key: values[step] for key, values in columns.items()}, "task": TASK}


def import_pusht(config: ImportPushTConfig) -> LeRobotDataset:
    """Write the dataset.

    Raises:
        ValueError: if the source does not have a requested episode; see also `load_arrays`.
    """
    arrays = load_arrays(config.source, with_images="image" in config.variant, images=config.images)
    bounds = [0, *arrays["episode_ends"].tolist()]
    n_episodes = len(bounds) - 1
    episodes = config.episodes or range(config.first_episodes or n_episodes)
    if max(episodes) >= n_episodes:
        option = "--episodes" if config.episodes else "--first_episodes"
        value = config.episodes or config.first_episodes
        raise ValueError(
            f"{option}={value}: {config.source} has {n_episodes} episodes, 0 to {n_episodes - 1}"
        )

    writer = DatasetWriter(config.root, config.repo_id, FPS, dataset_features(config.variant))
    frames = (
        episode_frames(arrays, slice(bounds[episode], bounds[episode + 1]), config.variant)
        for episode in episodes
    )
    with episode_bar("episodes", len(episodes)) as advance:
        return writer.write(frames, lambda: advance(1))


@entry_point("lerobot-agpd-import-pusht")
def main(config: ImportPushTConfig) -> None:
    """Import, report and optionally upload."""
    disable_progress_bars()  # one bar of the datasets library per episode would tear ours apart
    dataset = import_pusht(config)
    logger.info("%d episodes, %d frames in %s", dataset.num_episodes, dataset.num_frames, config.root)
    if config.push_to_hub:
        dataset.push_to_hub()


if __name__ == "__main__":
    main()
