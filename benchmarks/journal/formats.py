"""Compare ways to store an episode on disk: structured .npy files, and a zarr v3 group.

    python benchmarks/journal/formats.py --output benchmarks/journal/formats-cpu.json

Images are rendered: Push-T at 96 x 96, ALOHA at 480 x 640. Every number is the median over repetitions. `cold` reads
follow an `fadvise(DONTNEED)` of all files of the episode, so that they come from the disk.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
import zarr

from lerobot_agpd.files import write_array
from lerobot_agpd.replay.stored import camera_path, split_columns

VECTORS = {"observation.state": 14, "action": 14, "next.reward": 1}
CAMERA = "observation.image"


def rendered(name: str, n_steps: int) -> np.ndarray:
    """Frames (T, H, W, 3) of a random rollout."""
    if name == "96x96":
        import gym_pusht  # noqa: F401

        env = gym.make("gym_pusht/PushT-v0", obs_type="pixels", render_mode="rgb_array")
        image = lambda observation: observation  # noqa: E731
    else:
        import gym_aloha  # noqa: F401

        env = gym.make("gym_aloha/AlohaTransferCube-v0", obs_type="pixels", render_mode="rgb_array")
        image = lambda observation: observation["top"]  # noqa: E731
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    action, frames = env.action_space.sample(), []
    for step in range(n_steps):
        frames.append(image(observation).copy())
        if step % 10 == 0:
            action = env.action_space.sample()
        observation, _, ended, cut, _ = env.step(action)
        if ended or cut:
            observation, _ = env.reset()
    env.close()
    return np.stack(frames)


def episode(name: str, n_steps: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    columns = {key: rng.normal(size=(n_steps, dim)).astype(np.float32) for key, dim in VECTORS.items()}
    return {CAMERA: rendered(name, n_steps), **columns, "next.success": np.zeros(n_steps, dtype=bool)}


def synced(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)


class Npy:
    """One structured array, one row per step."""

    suffix = ".npy"

    def write(self, path: Path, columns: dict[str, np.ndarray]) -> None:
        write_array(path, columns)

    def open(self, path: Path) -> np.ndarray:
        return np.load(path, mmap_mode="r", allow_pickle=False)

    def column(self, opened: np.ndarray, key: str) -> np.ndarray:
        return np.array(opened[key])

    def frame(self, opened: np.ndarray, key: str, step: int) -> np.ndarray:
        return np.array(opened[key][step])


class SplitNpy:
    """One structured array for the vectors, one row per step, and one array per camera: what the journal writes."""

    suffix = ".split"  # a folder here, so that it can be renamed and measured like the others

    def write(self, path: Path, columns: dict[str, np.ndarray]) -> None:
        vectors, images = split_columns(columns)
        path.mkdir()
        write_array(path / "rank-0-000000.npy", vectors)
        for key, values in images.items():
            write_array(camera_path(path / "rank-0-000000.npy", key), values)

    def open(self, path: Path) -> dict[str, np.ndarray]:
        return {file.name: np.load(file, mmap_mode="r", allow_pickle=False) for file in path.iterdir()}

    def column(self, opened: dict[str, np.ndarray], key: str) -> np.ndarray:
        vectors = opened["rank-0-000000.npy"]
        return np.array(vectors[key] if key in vectors.dtype.names else opened[f"rank-0-000000.{key}.npy"])

    def frame(self, opened: dict[str, np.ndarray], key: str, step: int) -> np.ndarray:
        return np.array(opened[f"rank-0-000000.{key}.npy"][step])


class Zarr:
    """A group with one array per feature; cameras have one chunk per frame, in one file each or in one shard."""

    suffix = ".zarr"

    def __init__(self, sharded: bool):
        self.sharded = sharded

    def write(self, path: Path, columns: dict[str, np.ndarray]) -> None:
        group = zarr.open_group(path, mode="w")
        for key, column in columns.items():
            layout: dict[str, object] = {"chunks": column.shape}
            if column.ndim == 4:
                layout = {"chunks": (1, *column.shape[1:])} | (
                    {"shards": column.shape} if self.sharded else {}
                )
            array = group.create_array(
                key,
                shape=column.shape,
                dtype=column.dtype,
                compressors=zarr.codecs.ZstdCodec(level=1),
                **layout,
            )
            array[:] = column
        for file in path.rglob("*"):
            synced(file)

    def open(self, path: Path) -> zarr.Group:
        return zarr.open_group(path, mode="r")

    def column(self, opened: zarr.Group, key: str) -> np.ndarray:
        return opened[key][:]

    def frame(self, opened: zarr.Group, key: str, step: int) -> np.ndarray:
        return opened[key][step]


FORMATS = {
    "npy": Npy(),
    "npy_split": SplitNpy(),
    "zarr": Zarr(sharded=False),
    "zarr_sharded": Zarr(sharded=True),
}


def files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]


def forget(path: Path) -> None:
    """Drop the pages of an episode from the page cache."""
    for file in files_of(path):
        descriptor = os.open(file, os.O_RDONLY)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


def milliseconds(action: Callable[[], object], repetitions: int, before: Callable[[], object] = int) -> float:
    taken = []
    for _ in range(repetitions):
        before()
        began = time.perf_counter()
        action()
        taken.append((time.perf_counter() - began) * 1000)
    return statistics.median(taken)


def measure(form: Npy | SplitNpy | Zarr, columns: dict[str, np.ndarray], folder: Path) -> dict[str, float]:
    n_steps = len(columns["action"])
    path, partial = folder / f"episode{form.suffix}", folder / f"partial{form.suffix}"
    rng = np.random.default_rng(1)

    def append() -> None:
        form.write(partial, columns)
        partial.replace(path)
        synced(folder)

    def forgotten() -> None:
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)

    def random_frame() -> np.ndarray:
        return form.frame(opened, CAMERA, int(rng.integers(n_steps)))

    result = {"append_ms": milliseconds(append, 5, forgotten)}
    result["open_ms"] = milliseconds(lambda: form.open(path), 30)
    opened = form.open(path)
    assert all(np.array_equal(form.column(opened, key), column) for key, column in columns.items())
    result["frame_ms"] = milliseconds(random_frame, 200)
    result["column_ms"] = milliseconds(lambda: form.column(opened, "action"), 50)
    del opened

    def cold() -> None:
        nonlocal opened
        opened = None
        forget(path)
        opened = form.open(path)

    result["frame_cold_ms"] = milliseconds(random_frame, 50, cold)
    result["column_cold_ms"] = milliseconds(lambda: form.column(opened, "action"), 20, cold)
    opened = None
    sizes = [file.stat().st_size for file in files_of(path)]
    return {**result, "bytes": sum(sizes), "files": len(sizes)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument(
        "--folder", type=Path, help="where the episodes are written; default: a temporary one"
    )
    options = parser.parse_args()
    results = []
    for camera in ("96x96", "480x640"):
        longest = episode(camera, 400)
        for n_steps in (50, 400):
            columns = {key: column[:n_steps] for key, column in longest.items()}
            entry: dict[str, object] = {"camera": camera, "steps": n_steps}
            entry["raw_bytes"] = sum(column.nbytes for column in columns.values())
            for name, form in FORMATS.items():
                with tempfile.TemporaryDirectory(dir=options.folder) as folder:
                    entry[name] = measure(form, columns, Path(folder))
            results.append(entry)
            for key, value in entry["npy"].items():
                ratios = "  ".join(
                    f"{name}/npy {entry[name][key] / value:8.2f}" for name in FORMATS if name != "npy"
                )
                print(f"{camera:8} {n_steps:4} steps  {key:15} npy {value:14.3f}  {ratios}", flush=True)
    machine = {"cpus": os.cpu_count(), "platform": platform.platform(), "numpy": np.__version__}
    report = {"machine": machine | {"zarr": zarr.__version__}, "results": results}
    options.output.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
