"""`lerobot-agpd-import-pusht`: the human Push-T demonstrations of Diffusion Policy as a LeRobotDataset."""

import logging
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE
from lerobot.utils.utils import init_logging
from rich.progress import track

logger = logging.getLogger(__name__)

FPS = 10
TASK = "Push the T-shaped block onto the T-shaped target."


@dataclass
class ImportPushTConfig:
    """Options of `lerobot-agpd-import-pusht`."""

    source: Path  # .npz with Diffusion Policy's arrays state, action and episode_ends (and img for images)
    root: Path  # folder of the new dataset; must not exist
    repo_id: str = "local/pusht_keypoints"  # name of the new dataset
    variant: str = "keypoints"  # keypoints: block corners as environment_state; images: 96x96 camera
    episodes: list[int] | None = None  # episodes to keep, e.g. "[0,1,2]"; all by default
    first_episodes: int | None = None  # shorthand: keep episodes 0 .. n-1
    images: Path | None = None  # .npz with the array img, if it is not in source
    push_to_hub: bool = False  # upload the dataset when it is done

    def __post_init__(self) -> None:
        if self.variant not in ("keypoints", "images"):
            raise ValueError(f"--variant must be 'keypoints' or 'images', got '{self.variant}'")
        if self.root.exists():
            raise FileExistsError(f"--root={self.root} already exists; choose a new folder")
        if not self.source.is_file():
            raise FileNotFoundError(f"--source={self.source} is not a file")
        if self.episodes is not None and self.first_episodes is not None:
            raise ValueError("give either --episodes or --first_episodes, not both")


def load_arrays(config: ImportPushTConfig) -> dict[str, np.ndarray]:
    """Read the arrays that the variant needs.

    Raises:
        KeyError: if the file lacks one of them.
    """
    with np.load(config.source) as source:
        arrays = {key: source[key] for key in source.files}
    if config.images is not None:
        with np.load(config.images) as images:
            arrays["img"] = images["img"]
    needed = ["state", "action", "episode_ends"] + (["img"] if config.variant == "images" else [])
    missing = [key for key in needed if key not in arrays]
    if missing:
        raise KeyError(f"{config.source} has no array {missing}; found {sorted(arrays)}")
    return arrays


def block_keypoints(block_poses: np.ndarray) -> np.ndarray:
    """Corners of the T-block as gym_pusht's `environment_state` reports them.

    Args:
        block_poses: (N, 3) x, y in pixels and angle in radians.

    Returns:
        (N, 16) float32, eight corners as x, y pairs.
    """
    import pymunk
    from gym_pusht.envs.pusht import PushTEnv

    block, shapes = PushTEnv.add_tee(pymunk.Space(), (0, 0), 0)
    corners = np.empty((len(block_poses), 16), dtype=np.float32)
    for row, (x, y, angle) in zip(corners, block_poses.astype(float), strict=True):
        block.angle = (
            angle  # first: pymunk turns the block about its centre of gravity, which moves its origin
        )
        block.position = (x, y)
        row[:] = PushTEnv.get_keypoints(shapes).flatten()
    return corners


def dataset_features(variant: str) -> dict[str, dict[str, Any]]:
    """Features of lerobot/pusht_keypoints or lerobot/pusht that the recordings contain."""
    vector: dict[str, Any] = {"dtype": "float32", "names": None}
    features = {OBS_STATE: {**vector, "shape": (2,)}, ACTION: {**vector, "shape": (2,)}}
    if variant == "keypoints":
        features[OBS_ENV_STATE] = {**vector, "shape": (16,)}
    else:
        features[OBS_IMAGE] = {
            "dtype": "image",
            "shape": (96, 96, 3),
            "names": ["height", "width", "channel"],
        }
    return features


def import_pusht(config: ImportPushTConfig) -> LeRobotDataset:
    """Write the dataset, in a folder `<root>.partial` that is renamed when it is complete."""
    arrays = load_arrays(config)
    frames = {
        OBS_STATE: arrays["state"][:, :2].astype(np.float32),
        ACTION: arrays["action"].astype(np.float32),
    }
    if config.variant == "keypoints":
        frames[OBS_ENV_STATE] = block_keypoints(arrays["state"][:, 2:5])
    else:
        frames[OBS_IMAGE] = arrays["img"]
    ends = arrays["episode_ends"].tolist()
    starts = [0, *ends[:-1]]
    episodes = config.episodes if config.episodes is not None else range(config.first_episodes or len(ends))
    if max(episodes) >= len(ends):
        raise ValueError(f"episode {max(episodes)} was asked for, {config.source} has {len(ends)}")

    partial = config.root.with_name(config.root.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    dataset = LeRobotDataset.create(
        config.repo_id, fps=FPS, features=dataset_features(config.variant), root=partial, use_videos=False
    )
    for episode in track(list(episodes), description="episodes"):
        for step in range(starts[episode], ends[episode]):
            dataset.add_frame({**{key: values[step] for key, values in frames.items()}, "task": TASK})
        dataset.save_episode()
    dataset.finalize()
    partial.rename(config.root)
    return LeRobotDataset(config.repo_id, root=config.root)


@draccus.wrap()
def run(config: ImportPushTConfig) -> None:
    """Import, report and optionally upload."""
    dataset = import_pusht(config)
    logger.info("%d episodes, %d frames in %s", dataset.num_episodes, dataset.num_frames, config.root)
    if config.push_to_hub:
        dataset.push_to_hub()


def main() -> None:
    """Console entry point."""
    init_logging()
    run()


if __name__ == "__main__":
    main()
