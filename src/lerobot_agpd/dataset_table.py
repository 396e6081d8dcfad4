"""Write the episodes of a LeRobotDataset without cameras as one table per file.

LeRobot's recorder converts, embeds and writes every episode by itself, looking for images row by row. Here its own functions
check the frames, compute the statistics and keep the metadata; only the frames' values go to disk together.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import datasets
import numpy as np
from lerobot.datasets.compute_stats import compute_episode_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.feature_utils import get_hf_features_from_features, validate_frame
from lerobot.datasets.io_utils import write_table_one_row_group_per_episode
from lerobot.datasets.utils import update_chunk_file_indices
from numpy.typing import NDArray

Array = NDArray[Any]
Frame = dict[str, Any]


class EpisodeTable:
    """Episodes of a new dataset, in memory until a file is full.

    Args:
        meta: metadata of the dataset, which has no episodes yet and no cameras.
    """

    def __init__(self, meta: LeRobotDatasetMetadata):
        self.meta = meta
        self._episodes: list[dict[str, Array]] = []  # of the file to come
        self._bytes = 0
        self._file = (0, 0)  # chunk and file index

    def add(self, frames: Iterable[Frame]) -> None:
        """Add an episode.

        Raises:
            ValueError: if a frame's values are not those of the features, or there is no frame.
        """
        rows, tasks = [], []
        for frame in frames:
            validate_frame(frame, self.meta.features)
            tasks.append(frame["task"])
            rows.append(frame)
        if not rows:
            raise ValueError("an episode without frames")
        columns = self._columns(rows, tasks)
        chunk_index, file_index = self._file
        first = self.meta.total_frames
        self.meta.save_episode(
            episode_index=self.meta.total_episodes,
            episode_length=len(rows),
            episode_tasks=list(dict.fromkeys(tasks)),
            episode_stats=compute_episode_stats({**columns}, self.meta.features),
            episode_metadata={
                "data/chunk_index": chunk_index,
                "data/file_index": file_index,
                "dataset_from_index": first,
                "dataset_to_index": first + len(rows),
            },
        )
        self._episodes.append(columns)
        self._bytes += sum(values.nbytes for values in columns.values())
        if self._bytes >= self.meta.data_files_size_in_mb * 2**20:
            self._write_file()

    def finish(self) -> None:
        """Write what is left; then the dataset can be read."""
        if self._episodes:
            self._write_file()
        self.meta.finalize()

    def _columns(self, rows: list[Frame], tasks: list[str]) -> dict[str, Any]:
        """The values (T, ...) of an episode, LeRobot's own columns among them; features of one number are (T,)."""
        length, meta = len(rows), self.meta
        meta.save_episode_tasks(list(dict.fromkeys(tasks)))
        steps = np.arange(length)
        columns: dict[str, Any] = {
            "timestamp": steps / meta.fps,
            "frame_index": steps,
            "episode_index": np.full(length, meta.total_episodes),
            "index": meta.total_frames + steps,
            "task_index": np.array([meta.get_task_index(task) for task in tasks]),
        }
        for key, feature in meta.features.items():
            if key not in columns:
                values = np.stack([row[key] for row in rows])
                is_number = tuple(feature["shape"]) == (1,) and feature["dtype"] != "string"
                columns[key] = values.reshape(length) if is_number else values
        return {key: columns[key] for key in meta.features}

    def _write_file(self) -> None:
        features = get_hf_features_from_features(self.meta.features)
        columns = {key: np.concatenate([episode[key] for episode in self._episodes]) for key in features}
        table = datasets.Dataset.from_dict(columns, features=features).with_format("arrow")[:]
        chunk_index, file_index = self._file
        path = self.meta.root / self.meta.data_path.format(chunk_index=chunk_index, file_index=file_index)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_table_one_row_group_per_episode(table, path)
        self._episodes, self._bytes = [], 0
        self._file = update_chunk_file_indices(chunk_index, file_index, self.meta.chunks_size)
