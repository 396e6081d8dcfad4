"""Write a LeRobotDataset so that a killed run leaves nothing half-written, and can go on.

LeRobot cannot open a dataset again that was killed before `finalize`. So episodes go to `<root>.partial`, in shards:
small datasets, each renamed once it is complete. At the end the shards become one dataset, which takes its final name last.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import batched
from pathlib import Path
from typing import Any, Literal

from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.dataset_table import EpisodeTable

logger = logging.getLogger(__name__)

Frame = dict[str, Any]
"""One value per feature, and the sentence `task`."""

Feature = dict[str, Any]
"""LeRobot's description of one value of a frame: dtype, shape and names."""

JsonDict = Mapping[str, Any]
PLAN = "plan.json"

CAMERAS = ("image", "video")
"""Dtypes of camera features."""


def vector(dim: int) -> Feature:
    """Feature of `dim` float32 numbers."""
    return {"dtype": "float32", "shape": (dim,), "names": None}


def flag() -> Feature:
    """Feature of one bool."""
    return {"dtype": "bool", "shape": (1,), "names": None}


def image(shape: tuple[int, ...], dtype: Literal["image", "video"] = "image") -> Feature:
    """Feature of a uint8 image (height, width, channels), stored as PNG or in a video."""
    return {"dtype": dtype, "shape": shape, "names": ["height", "width", "channel"]}


@dataclass(frozen=True)
class DatasetWriter:
    """Writer of one dataset.

    Attributes:
        root: folder of the dataset; must not exist.
        repo_id: name of the dataset.
        fps: frames per second.
        features: LeRobot's description of every value of a frame.
        robot_type: LeRobot's name of the robot.
        use_videos: whether images are stored as video.
        plan: what decides the contents beside the above, of JSON types. A killed run goes on if its plan is the same;
            without a plan every run starts anew.
        episodes_per_shard: how many episodes a killed run with a plan repeats at most.
    """

    root: Path
    repo_id: str
    fps: int
    features: dict[str, Feature]
    robot_type: str | None = None
    use_videos: bool = False
    plan: JsonDict | None = None
    episodes_per_shard: int = 20

    @property
    def partial_root(self) -> Path:
        """Folder in which the dataset grows."""
        return self.root.with_name(self.root.name + ".partial")

    def write(
        self,
        episodes: Iterable[Iterable[Frame]],
        on_episode: Callable[[], None] = lambda: None,
        add_files: Callable[[Path], None] = lambda folder: None,
    ) -> LeRobotDataset:
        """Write all episodes that no finished shard holds.

        `<root>.partial` is removed where nothing can go on from it: after a ValueError (wrong input), and after any
        exception in a run without a plan.

        Args:
            episodes: the frames of every episode; episodes of finished shards are not iterated over.
            on_episode: called once per episode, be it written now or before.
            add_files: adds files to the complete dataset before it takes its final name.

        Returns:
            The dataset, as read back.

        Raises:
            FileExistsError: if `root` exists, or `<root>.partial` holds something else.
            ValueError: if there is no episode.
        """
        self._claim()
        try:
            shards = batched(episodes, self.episodes_per_shard) if self.plan is not None else [episodes]
            folders = [self._shard(number, shard, on_episode) for number, shard in enumerate(shards)]
            if not folders:
                raise ValueError(f"no episode to write to {self.root}")
            merged = self._merged(folders)
            add_files(merged)
            merged.rename(self.root)
        except BaseException as error:
            if self.plan is None or isinstance(error, ValueError):
                shutil.rmtree(self.partial_root)
            raise
        shutil.rmtree(self.partial_root)
        return LeRobotDataset(self.repo_id, root=self.root)

    def _claim(self) -> None:
        """Create `<root>.partial` with the plan inside, or check that the one that is there has the same plan."""
        if self.root.exists():
            raise FileExistsError(f"{self.root} already exists; choose a new folder")
        plan = self._full_plan()
        if self.partial_root.exists():
            if not (self.partial_root / PLAN).exists():
                raise FileExistsError(
                    f"{self.partial_root} is no unfinished dataset; remove it or choose another root"
                )
            if self.plan is not None:
                return _require_same(
                    json.loads((self.partial_root / PLAN).read_text()), plan, self.partial_root
                )
            logger.warning("removing %s, left by an interrupted run", self.partial_root)
            shutil.rmtree(self.partial_root)
        new = self.root.with_name(self.root.name + ".new")
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir(parents=True)
        (new / PLAN).write_text(json.dumps(plan, indent=2) + "\n")
        new.rename(self.partial_root)  # so that a partial folder always has its plan
        return None

    def _full_plan(self) -> JsonDict:
        features = {key: f"{value['dtype']} {list(value['shape'])}" for key, value in self.features.items()}
        common = {"repo_id": self.repo_id, "fps": self.fps, "features": features}
        return {**common, "episodes_per_shard": self.episodes_per_shard, **(self.plan or {})}

    def _shard(
        self, number: int, episodes: Iterable[Iterable[Frame]], on_episode: Callable[[], None]
    ) -> Path:
        """Return a shard's folder, written unless it is there."""
        folder = self.partial_root / f"shard-{number:06d}"
        if folder.exists():
            for _ in episodes:
                on_episode()
            return folder
        unfinished = self.partial_root / "unfinished"
        shutil.rmtree(unfinished, ignore_errors=True)
        has_cameras = any(feature["dtype"] in CAMERAS for feature in self.features.values())
        n_episodes = (self._record if has_cameras else self._write_table)(unfinished, episodes, on_episode)
        if not n_episodes:
            raise ValueError(f"no episode to write to {self.root}")
        unfinished.rename(folder)
        return folder

    def _write_table(
        self, root: Path, episodes: Iterable[Iterable[Frame]], on_episode: Callable[[], None]
    ) -> int:
        """Write a dataset without cameras; returns its number of episodes."""
        meta = LeRobotDatasetMetadata.create(
            self.repo_id, self.fps, self.features, self.robot_type, root, use_videos=False
        )
        table = EpisodeTable(meta)
        try:
            for frames in episodes:
                table.add(frames)
                on_episode()
            table.finish()
        finally:  # as below
            meta.finalize()
        return meta.total_episodes

    def _record(self, root: Path, episodes: Iterable[Iterable[Frame]], on_episode: Callable[[], None]) -> int:
        """Write a dataset with cameras, as LeRobot records; returns its number of episodes."""
        dataset = LeRobotDataset.create(
            self.repo_id,
            fps=self.fps,
            features=self.features,
            root=root,
            robot_type=self.robot_type,
            use_videos=self.use_videos,
        )
        try:
            for frames in episodes:
                for frame in frames:
                    dataset.add_frame(frame)
                dataset.save_episode()
                on_episode()
        finally:  # LeRobot would do it at garbage collection, and create a folder again that was removed
            dataset.finalize()
        return dataset.num_episodes

    def _merged(self, shards: list[Path]) -> Path:
        """Return the folder of all shards as one dataset."""
        merged = self.partial_root / "merged"
        shutil.rmtree(merged, ignore_errors=True)
        if len(shards) == 1:
            return shards[0].rename(merged)
        names = [f"local/{shard.name}" for shard in shards]
        aggregate_datasets(repo_ids=names, aggr_repo_id=self.repo_id, roots=shards, aggr_root=merged)
        return merged


def _require_same(begun: JsonDict, plan: JsonDict, folder: Path) -> None:
    differences = [
        f"{key} was {begun.get(key)}, is now {plan.get(key)}"
        for key in sorted({*begun, *plan})
        if begun.get(key) != plan.get(key)
    ]
    if differences:
        raise FileExistsError(
            f"{folder} holds an unfinished dataset with other options ({'; '.join(differences)}): repeat those, or "
            "remove the folder to start anew"
        )
