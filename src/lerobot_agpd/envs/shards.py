"""Writing a long dataset so that a killed run can go on.

LeRobot cannot reopen a dataset that was not finalised. So episodes are written in shards, small datasets in
`<root>.partial`, each renamed when it is complete; at the end LeRobot merges them into one.
"""

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

Frame = dict[str, Any]

PLAN = "plan.json"


class ShardedWriter:
    """Writes a dataset in shards to `<root>.partial`, and goes on where a killed run of the same plan stopped."""

    def __init__(self, root: Path, plan: Mapping[str, Any]):
        """Claim the folder.

        Args:
            root: folder of the finished dataset.
            plan: what decides the dataset's contents, JSON types only; shards of another plan do not fit.

        Raises:
            FileExistsError: naming the differences, if the folder holds another plan's shards or something else.
        """
        self.root, self.partial = root, root.with_name(root.name + ".partial")
        if not self.partial.exists():
            new = root.with_name(root.name + ".new")
            shutil.rmtree(new, ignore_errors=True)
            new.mkdir(parents=True)
            (new / PLAN).write_text(json.dumps(plan, indent=2) + "\n")
            new.rename(self.partial)
        elif not (self.partial / PLAN).exists():
            raise FileExistsError(
                f"{self.partial} is no unfinished import; remove it or choose another --root"
            )
        begun = json.loads((self.partial / PLAN).read_text())
        differences = [
            f"{key} was {begun.get(key)}, is now {plan.get(key)}"
            for key in sorted({*begun, *plan})
            if begun.get(key) != plan.get(key)
        ]
        if differences:
            raise FileExistsError(
                f"{self.partial} holds an unfinished import with other options ({'; '.join(differences)}): repeat "
                "those, or remove the folder to start anew"
            )

    def write(
        self,
        n_episodes: int,
        episodes_per_shard: int,
        create: Callable[[Path], LeRobotDataset],
        frames: Callable[[int], Iterator[Frame]],
        advance: Callable[[int], None],
    ) -> None:
        """Write the episodes that no finished shard holds.

        Args:
            n_episodes: episodes of the whole dataset.
            episodes_per_shard: how many a killed run loses at most.
            create: makes an empty dataset in a new folder.
            frames: the frames of an episode.
            advance: told how many more episodes are there, be they written now or before.
        """
        for start in range(0, n_episodes, episodes_per_shard):
            episodes = range(start, min(start + episodes_per_shard, n_episodes))
            if self._shard(start).exists():
                advance(len(episodes))
                continue
            shutil.rmtree(self._unfinished, ignore_errors=True)
            shard = create(self._unfinished)
            for episode in episodes:
                for frame in frames(episode):
                    shard.add_frame(frame)
                shard.save_episode()
                advance(1)
            shard.finalize()
            self._unfinished.rename(self._shard(start))

    @property
    def _unfinished(self) -> Path:
        return self.partial / "unfinished"

    def _shard(self, first_episode: int) -> Path:
        return self.partial / f"shard-{first_episode:06d}"

    def merge(self, repo_id: str, add: Callable[[Path], None]) -> LeRobotDataset:
        """Merge the shards into the finished dataset and remove them.

        Args:
            repo_id: name of the dataset.
            add: adds files to the merged folder before it takes its final name.
        """
        merged = self.partial / "merged"
        shutil.rmtree(merged, ignore_errors=True)
        shards = sorted(self.partial.glob("shard-*"))
        aggregate_datasets(
            repo_ids=[f"local/{shard.name}" for shard in shards],
            aggr_repo_id=repo_id,
            roots=shards,
            aggr_root=merged,
        )
        add(merged)
        merged.rename(self.root)
        shutil.rmtree(self.partial)
        return LeRobotDataset(repo_id, root=self.root)
