"""`lerobot-agpd-import-pusht`: the human Push-T demonstrations of Diffusion Policy as a LeRobotDataset.

They come as Diffusion Policy's own replay buffer (arXiv:2303.04137), a zarr v2 group with `data/state`,
`data/action`, `data/img` and `meta/episode_ends`, in a folder or a zip file; or as an .npz file with the arrays
`state`, `action`, `img` and `episode_ends`.
"""

import logging
import shutil
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import draccus
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DONE, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE, REWARD, SUCCESS
from rich.progress import track

from lerobot_agpd.cli.command import command

logger = logging.getLogger(__name__)

FPS = 10
TASK = "Push the T-shaped block onto the T-shaped target."
GOAL_POSE = (256.0, 256.0, np.pi / 4)
SUCCESS_COVERAGE = 0.95
VARIANTS = ("keypoints", "state", "image")
EPISODE_ENDS = "meta/episode_ends"
ROWS_PER_READ = 1024


@dataclass
class ImportPushTConfig:
    """Options of `lerobot-agpd-import-pusht`."""

    source: (
        Path  # Diffusion Policy's replay buffer, a zarr folder or a zip of it, or its arrays in an .npz file
    )
    root: Path  # folder of the new dataset; must not exist
    repo_id: str = "local/pusht_keypoints"  # name of the new dataset
    variant: str = (
        "keypoints"  # beside the agent, keypoints: block corners; state: block pose; image: 96x96 camera
    )
    episodes: list[int] | None = None  # episodes to keep, e.g. "[0,1,2]"; all by default
    first_episodes: int | None = None  # shorthand: keep episodes 0 .. n-1
    images: Path | None = None  # .npz with the array img, if it is not in source
    push_to_hub: bool = False  # upload the dataset when it is done

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise ValueError(f"--variant must be one of {', '.join(VARIANTS)}; got '{self.variant}'")
        if self.root.exists():
            raise FileExistsError(f"--root={self.root} already exists; choose a new folder")
        if not self.source.exists():
            raise FileNotFoundError(f"--source={self.source} does not exist")
        if self.episodes is not None and self.first_episodes is not None:
            raise ValueError("give either --episodes or --first_episodes, not both")


def load_arrays(config: ImportPushTConfig) -> dict[str, np.ndarray]:
    """Read the arrays that the variant needs.

    Returns:
        `state` (N, 5), `action` (N, 2), `episode_ends` (episodes,) and, for images, `img` (N, 96, 96, 3) uint8.

    Raises:
        KeyError: if the file lacks one of them.
        ValueError: if a folder or zip file holds no replay buffer.
        ModuleNotFoundError: if it holds one and the package zarr is not installed.
    """
    needed = ["state", "action", "episode_ends"] + (["img"] if config.variant == "image" else [])
    if config.source.suffix == ".npz":
        arrays = _load_npz(config.source, needed)
    else:
        arrays = _load_zarr(config.source, needed if config.images is None else needed[:3])
    if config.images is not None:
        arrays.update(_load_npz(config.images, ["img"]))
    missing = [key for key in needed if key not in arrays]
    if missing:
        raise KeyError(f"--source={config.source} has no array {missing}; found {sorted(arrays)}")
    return arrays


def _load_npz(path: Path, needed: Iterable[str]) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        found = archive.files
        arrays = {key: archive[key] for key in needed if key in found}
    return arrays or {key: np.empty(0) for key in found}  # foreign names, for the message


def _load_zarr(path: Path, needed: Iterable[str]) -> dict[str, np.ndarray]:
    """Read a replay buffer that lies in a folder or zip file, at its top or in a folder inside."""
    try:
        import zarr
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"--source={path} is a zarr replay buffer; reading it needs the package zarr. "
            "Run: pip install 'lerobot_policy_agpd[zarr]'",
            name="zarr",
        ) from error
    prefix = _group_inside(path)
    store = zarr.storage.ZipStore(path, mode="r") if path.is_file() else zarr.storage.LocalStore(path)
    group = zarr.open_group(store, path=prefix, mode="r")
    names = {key: EPISODE_ENDS if key == "episode_ends" else f"data/{key}" for key in needed}
    arrays = {key: _read(group[name]) for key, name in names.items() if name in group}
    store.close()
    return arrays


def _group_inside(path: Path) -> str:
    """Path of the replay buffer inside a folder or zip file; empty if it is at the top.

    Raises:
        ValueError: if there is none.
    """
    marker = f"{EPISODE_ENDS}/.zarray"
    if path.is_dir():
        members = [found.relative_to(path).as_posix() for found in path.rglob(marker)]
    elif zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            members = [name for name in archive.namelist() if name.endswith(marker)]
    else:
        members = []
    if not members:
        raise ValueError(
            f"--source={path} is no replay buffer: expected an .npz file, or a zarr v2 folder or zip file with "
            f"{EPISODE_ENDS}"
        )
    prefix = str(PurePosixPath(min(members, key=len)).parents[2])
    return "" if prefix == "." else prefix


def _read(array: Any) -> np.ndarray:
    """Read an array; images, which Diffusion Policy stores as floats in [0, 255], become uint8 block by block."""
    if array.ndim < 4:
        return np.asarray(array[:])
    images = np.empty(array.shape, dtype=np.uint8)
    for start in range(0, len(images), ROWS_PER_READ):
        images[start : start + ROWS_PER_READ] = array[start : start + ROWS_PER_READ]
    return images


def block_geometry(block_poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the T-block as gym_pusht's `environment_state` reports them, and its share of the target covered.

    Args:
        block_poses: (N, 3) x, y in pixels and angle in radians.

    Returns:
        (N, 16) float32, eight corners as x, y pairs, and (N,) coverage in [0, 1].
    """
    import pymunk
    from gym_pusht.envs.pusht import PushTEnv, pymunk_to_shapely

    block, shapes = PushTEnv.add_tee(pymunk.Space(), (0, 0), 0)
    target = pymunk_to_shapely(PushTEnv.get_goal_pose_body(np.array(GOAL_POSE)), shapes)
    corners = np.empty((len(block_poses), 16), dtype=np.float32)
    coverage = np.empty(len(block_poses))
    for step, (x, y, angle) in enumerate(block_poses.astype(float)):
        block.angle = angle  # first: pymunk turns a body about its centre of gravity, which moves its origin
        block.position = (x, y)
        corners[step] = PushTEnv.get_keypoints(shapes).flatten()
        coverage[step] = target.intersection(pymunk_to_shapely(block, shapes)).area / target.area
    return corners, coverage


def dataset_features(variant: str) -> dict[str, dict[str, Any]]:
    """Features of lerobot/pusht_keypoints (keypoints) or lerobot/pusht (image); state has the block's pose instead."""
    vector: dict[str, Any] = {"dtype": "float32", "names": None}
    flag = {"dtype": "bool", "shape": (1,), "names": None}
    features: dict[str, dict[str, Any]] = {
        OBS_STATE: {**vector, "shape": (2,)},
        ACTION: {**vector, "shape": (2,)},
        REWARD: {**vector, "shape": (1,)},
        SUCCESS: dict(flag),
        DONE: dict(flag),
    }
    if variant == "image":
        names = ["height", "width", "channel"]
        features[OBS_IMAGE] = {"dtype": "image", "shape": (96, 96, 3), "names": names}
    else:
        features[OBS_ENV_STATE] = {**vector, "shape": (16,) if variant == "keypoints" else (3,)}
    return features


def episode_frames(
    arrays: dict[str, np.ndarray], start: int, end: int, variant: str
) -> dict[str, np.ndarray]:
    """Columns of one episode.

    Reward and success are those of the state that an action leads to, of the last state itself at the end; the
    recordings do not hold them.

    Args:
        arrays: see `load_arrays`.
        start: its first row.
        end: the row after its last.
        variant: one of `VARIANTS`.
    """
    state = arrays["state"][start:end]
    corners, coverage = block_geometry(state[:, 2:5])
    reached = np.append(coverage[1:], coverage[-1])[:, None]  # (T, 1)
    done = np.zeros((len(state), 1), dtype=bool)
    done[-1] = True
    columns = {
        OBS_STATE: state[:, :2].astype(np.float32),
        ACTION: arrays["action"][start:end].astype(np.float32),
        REWARD: np.clip(reached / SUCCESS_COVERAGE, 0, 1).astype(np.float32),
        SUCCESS: reached > SUCCESS_COVERAGE,
        DONE: done,
    }
    if variant == "image":
        columns[OBS_IMAGE] = arrays["img"][start:end]
    else:
        columns[OBS_ENV_STATE] = corners if variant == "keypoints" else state[:, 2:5].astype(np.float32)
    return columns


def import_pusht(config: ImportPushTConfig) -> LeRobotDataset:
    """Write the dataset, in a folder `<root>.partial` that is renamed when it is complete.

    Raises:
        ValueError: if an episode is asked for that the source does not have; and see `load_arrays`.
    """
    arrays = load_arrays(config)
    ends = arrays["episode_ends"].tolist()
    starts = [0, *ends[:-1]]
    episodes = config.episodes if config.episodes is not None else range(config.first_episodes or len(ends))
    if max(episodes) >= len(ends):
        raise ValueError(f"episode {max(episodes)} was asked for, {config.source} has {len(ends)}")

    partial = config.root.with_name(config.root.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    features = dataset_features(config.variant)
    dataset = LeRobotDataset.create(
        config.repo_id, fps=FPS, features=features, root=partial, use_videos=False
    )
    for episode in track(list(episodes), description="episodes"):
        columns = episode_frames(arrays, starts[episode], ends[episode], config.variant)
        for step in range(ends[episode] - starts[episode]):
            dataset.add_frame({**{key: values[step] for key, values in columns.items()}, "task": TASK})
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
    with command("lerobot-agpd-import-pusht"):
        run()


if __name__ == "__main__":
    main()
