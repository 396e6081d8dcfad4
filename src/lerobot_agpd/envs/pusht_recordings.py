"""Reading the human Push-T demonstrations of Diffusion Policy (arXiv:2303.04137).

They come as Diffusion Policy's own replay buffer, a zarr v2 group with `data/state`, `data/action`, `data/img` and
`meta/episode_ends`, in a folder or a zip file; or as an .npz file with the arrays `state`, `action`, `img` and
`episode_ends`.
"""

import zipfile
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lerobot_agpd.envs.images import read_images
from lerobot_agpd.envs.packages import require_packages

Arrays = dict[str, np.ndarray]

EPISODE_ENDS = "meta/episode_ends"
IMAGE_SHAPE = (96, 96, 3)
SHAPES = {"state": (5,), "action": (2,), "img": IMAGE_SHAPE}
"""Shape of one step of every array."""
GOAL_POSE = (256.0, 256.0, np.pi / 4)


def load_arrays(source: Path, with_images: bool = False, images: Path | None = None) -> Arrays:
    """Read and check the arrays.

    Args:
        source: folder, zip file or .npz file.
        with_images: whether to read images.
        images: .npz file with the array `img`, if it is not in `source`.

    Returns:
        `state` (N, 5), `action` (N, 2), `episode_ends` (episodes,) and, with images, `img` (N, 96, 96, 3) uint8.

    Raises:
        ValueError: if the source holds no replay buffer, lacks an array or has one that does not fit the others.
        ModuleNotFoundError: if it is a zarr replay buffer and the package zarr is not installed.
    """
    names = ["state", "action", "episode_ends"] + ["img"] * (with_images and images is None)
    arrays = (_load_npz if source.suffix == ".npz" else _load_zarr)(source, names)
    if with_images and images is not None:
        arrays |= _load_npz(images, ["img"])
    _check(arrays, source)
    return arrays


def _load_npz(path: Path, names: Iterable[str]) -> Arrays:
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path} is not an .npz file")
    with np.load(path) as archive:
        return _read(archive, {name: name for name in names}, str(path))


def _load_zarr(path: Path, names: Iterable[str]) -> Arrays:
    """Read a replay buffer that lies in a folder or zip file, at its top or in a folder inside."""
    require_packages(["zarr"], f"{path}, a zarr replay buffer,", extra="zarr")
    import zarr

    prefix = _group_inside(path)
    store = zarr.storage.ZipStore(path, mode="r") if path.is_file() else zarr.storage.LocalStore(path)
    group = zarr.open_group(store, path=prefix, mode="r")
    places = {name: EPISODE_ENDS if name == "episode_ends" else f"data/{name}" for name in names}
    try:
        return _read(group, places, str(path))
    finally:
        store.close()


def _read(archive: Any, places: dict[str, str], source: str) -> Arrays:
    """Read arrays by name, each from its place in an archive (of numpy or zarr, which both act as mappings).

    Raises:
        ValueError: naming the arrays that are missing, or images that are none.
    """
    missing = [place for place in places.values() if place not in archive]
    if missing:
        raise ValueError(f"{source} has no array {missing}; found {sorted(archive)}")
    return {
        name: read_images(archive[place], f"{source}: {place}") if name == "img" else archive[place][:]
        for name, place in places.items()
    }


def _check(arrays: Arrays, source: Path) -> None:
    """Check that the arrays have their shapes and finite numbers, and that the episodes lie within them."""
    n_steps = len(arrays["state"])
    for name, shape in SHAPES.items():
        if name not in arrays:
            continue
        if arrays[name].shape != (n_steps, *shape):
            raise ValueError(f"{source}: {name} has shape {arrays[name].shape}, expected {(n_steps, *shape)}")
        if name != "img" and not (finite := np.isfinite(arrays[name]).all(axis=1)).all():
            raise ValueError(f"{source}: {name} is not finite in row {int(np.argmin(finite))}")
    ends = arrays["episode_ends"]
    if ends.ndim != 1 or ends.dtype.kind not in "iu" or len(ends) == 0:
        raise ValueError(f"{source}: episode_ends must be row numbers, found {ends.dtype} {ends.shape}")
    if ends[0] < 1 or (np.diff(ends.astype(np.int64)) < 1).any():
        raise ValueError(
            f"{source}: episode_ends must rise from episode to episode, found {ends.tolist()[:10]}"
        )
    if ends[-1] > n_steps:
        raise ValueError(f"{source}: episode_ends reaches row {ends[-1]}, the arrays have {n_steps}")


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
            f"{path} is no replay buffer: expected an .npz file, or a zarr v2 folder or zip file with "
            f"{EPISODE_ENDS}"
        )
    prefix = str(PurePosixPath(min(members, key=len)).parents[2])
    return "" if prefix == "." else prefix


def block_geometry(block_poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the T-block as gym_pusht's `environment_state` reports them, and its fraction of the target covered.

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
        block.angle = angle  # first: pymunk turns a body about its center of gravity, which moves its origin
        block.position = (x, y)
        corners[step] = PushTEnv.get_keypoints(shapes).flatten()
        coverage[step] = target.intersection(pymunk_to_shapely(block, shapes)).area / target.area
    return corners, coverage
