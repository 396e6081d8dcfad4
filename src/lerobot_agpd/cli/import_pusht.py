"""`lerobot-agpd-import-pusht`: the human Push-T demonstrations of Diffusion Policy as a LeRobotDataset."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DONE, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE, REWARD, SUCCESS

from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.cli.datasets import NewDataset, finish, write
from lerobot_agpd.dataset_writer import DatasetWriter, Frame, flag, image, vector
from lerobot_agpd.envs.pusht_recordings import IMAGE_SHAPE, Arrays, block_geometry, load_arrays

FPS = 10
TASK = "Push the T-shaped block onto the T-shaped target."
SUCCESS_COVERAGE = 0.95

Variant = Literal["keypoints", "state", "image"]


@dataclass(kw_only=True)
class ImportPushTConfig(NewDataset):
    """Options of `lerobot-agpd-import-pusht`."""

    # Diffusion Policy's replay buffer, a zarr folder or a zip of it, or its arrays in an .npz file.
    source: Path
    # Name of the new dataset.
    repo_id: str = "local/pusht_keypoints"
    # Observation beside the agent's position: the block's corners (keypoints) or pose (state), or a 96x96 image.
    variant: Variant = "keypoints"
    # Keep episodes 0 to n-1; default: all.
    first_episodes: int | None = None
    # .npz file with the array img, if it is not in source.
    images: Path | None = None

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ValueError: if an option is impossible.
            FileExistsError: if `root` exists.
            FileNotFoundError: if `source` does not.
        """
        super().__post_init__()
        for name, path in (("source", self.source), ("images", self.images)):
            if path is not None and not path.exists():
                raise FileNotFoundError(f"--{name}={path} does not exist")
        if self.first_episodes is not None and self.first_episodes < 1:
            raise ValueError(f"--first_episodes must be at least 1, got {self.first_episodes}")


def dataset_features(variant: Variant) -> dict[str, dict[str, Any]]:
    """Features of lerobot/pusht_keypoints (keypoints) or lerobot/pusht (image); state has the block's pose instead."""
    beside_agent = {
        "keypoints": {OBS_ENV_STATE: vector(16)},
        "state": {OBS_ENV_STATE: vector(3)},
        "image": {OBS_IMAGE: image(IMAGE_SHAPE)},
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
    if variant == "image":
        columns[OBS_IMAGE] = arrays["img"][rows]
    else:
        columns[OBS_ENV_STATE] = corners if variant == "keypoints" else state[:, 2:5].astype(np.float32)
    for step in range(len(state)):
        yield {**{key: values[step] for key, values in columns.items()}, "task": TASK}


def import_pusht(config: ImportPushTConfig) -> LeRobotDataset:
    """Write the dataset.

    Raises:
        ValueError: if the source has fewer episodes than requested; see also `load_arrays`.
    """
    arrays = load_arrays(config.source, with_images=config.variant == "image", images=config.images)
    ends = arrays["episode_ends"].tolist()
    n_episodes = config.first_episodes or len(ends)
    if n_episodes > len(ends):
        raise ValueError(f"--first_episodes={n_episodes}: {config.source} has {len(ends)} episodes")
    rows = map(slice, [0, *ends], ends[:n_episodes])
    writer = DatasetWriter(config.root, config.repo_id, FPS, dataset_features(config.variant))
    frames = (episode_frames(arrays, episode, config.variant) for episode in rows)
    return write(writer, frames, n_episodes)


@entry_point("lerobot-agpd-import-pusht")
def main(config: ImportPushTConfig) -> None:
    """Import, report and optionally upload."""
    finish(import_pusht(config), config.push_to_hub)


if __name__ == "__main__":
    main()
