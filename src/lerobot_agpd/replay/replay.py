"""The replay T during training: demonstrations in memory plus the frames of every finished round."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.memory import Batch, FrameMemory, gather_rows

logger = logging.getLogger(__name__)

ROW = "agpd.row"
"""Batch key of each row's number in T: demonstrations first, under the dataset's own frame index."""


class Replay:
    """T: only ever grows.

    The loader decides which demonstration frames are delivered; a share of them is exchanged for frames of
    collected episodes. Episodes that the loader never delivers (left out by `--dataset.episodes`, or held out)
    are never used.

    Args:
        memory: the demonstrations.
        config: the student's configuration; its `chunk_offsets` are the steps of a chunk relative to the current
            one, its `observation_history` the steps of an observation (None: no time dimension).
        collected_share: share of rows exchanged; None draws uniformly from T.
        image_transforms: what the loader does to the training images (..., C, H, W) in [0, 1] that it delivers; T does
            it to those that it reads itself.
    """

    def __init__(
        self,
        memory: FrameMemory,
        config: Any,
        collected_share: float | None,
        image_transforms: Callable[[Tensor], Tensor] | None = None,
    ):
        self.memory = memory
        self.config = config
        self.collected_share = collected_share
        self.image_transforms = image_transforms
        self.collected_raw: FrameTable | None = None
        self.seen_episodes: set[int] = set()
        self._table: FrameTable | None = None
        self._raw: FrameTable | None = None
        self._sources: list[tuple[int, LeRobotDataset]] = [(0, memory.dataset)]
        self._tasks: dict[int, list[str]] = {0: _tasks(memory.dataset)}
        self._n_dropped: int = getattr(config, "drop_n_last_frames", 0)  # ACT has no such setting
        self._demonstrated = _beginnings(memory.dataset, self._n_dropped)
        self._drawn = torch.empty(0, dtype=torch.long)  # rows of `collected_raw` that may begin a chunk
        self._action_offsets = torch.as_tensor(config.chunk_offsets)
        self._n_obs_steps: int | None = config.observation_history
        self._cameras = list(config.image_features)

    # ---- contents ----

    @property
    def n_demonstration_frames(self) -> int:
        """Rows of the demonstration dataset, selected or not."""
        return len(self.memory.table)

    @property
    def n_collected_frames(self) -> int:
        """Frames of kept episodes."""
        return 0 if self.collected_raw is None else len(self.collected_raw)

    @property
    def table(self) -> FrameTable:
        """All of T in the student's normalised space."""
        if self._table is None:
            self._table = self.memory.normalised
            if self.collected_raw is not None:
                device = self._table.episode_start.device
                self._table = self._table.concatenated(self.memory.normalise(self.collected_raw, device))
        return self._table

    @property
    def raw(self) -> FrameTable:
        """All of T in the environment's units, on the CPU."""
        if self._raw is None:
            collected = self.collected_raw
            self._raw = self.memory.table.concatenated(collected) if collected else self.memory.table
        return self._raw

    def add_dataset(self, root: Path) -> None:
        """Append the episodes of a finished round's dataset."""
        dataset = LeRobotDataset(f"agpd/{root.parent.name}-{root.name}", root=root)
        frames = FrameTable.from_dataset(dataset, self.memory.keys)
        start = self.n_demonstration_frames + self.n_collected_frames
        self._sources.append((start, dataset))
        self._tasks[start] = _tasks(dataset)
        self.collected_raw = frames if self.collected_raw is None else self.collected_raw.concatenated(frames)
        self._drawn = self.collected_raw.rows_before_end(self._n_dropped)
        if not len(frames.rows_before_end(self._n_dropped)):
            logger.warning(
                "no episode in %s is longer than --policy.drop_n_last_frames=%d: none is trained on",
                root,
                self._n_dropped,
            )
        self._table = self._raw = None

    # ---- rows ----

    def observe(self, batch: Batch) -> None:
        """Take note of what the loader delivers in training: its statistics and its episodes."""
        self.memory.observe(batch)
        self.seen_episodes.update(batch["episode_index"].tolist())

    def share(self) -> float:
        """Share of rows that collected frames fill."""
        if len(self._drawn) == 0:
            return 0.0
        if self.collected_share is not None:
            return self.collected_share
        # Uniform over the frames that begin a chunk: on both sides, an episode's dropped ones count for nothing.
        demonstrated = int(self._demonstrated[sorted(self.seen_episodes)].sum())
        return len(self._drawn) / (demonstrated + len(self._drawn))

    def training_rows(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Rows of T for a training step: the loader's frames, a share exchanged for collected ones."""
        rows = batch["index"].clone()
        exchanged = torch.rand(len(rows), generator=generator) < self.share()
        n_exchanged = int(exchanged.sum())
        if n_exchanged:
            drawn = self._drawn[torch.randint(len(self._drawn), (n_exchanged,), generator=generator)]
            rows[exchanged.to(rows.device)] = (self.n_demonstration_frames + drawn).to(rows)
        return self._gather(batch, rows, augment=True)

    def demonstration_rows(self, batch: Batch) -> Batch:
        """The loader's frames with their chunks, for a held-out loss."""
        return self._gather(batch, batch["index"])

    def _gather(self, batch: Batch, rows: Tensor, augment: bool = False) -> Batch:
        gathered = gather_rows(self.table, rows, self.config, self._action_offsets, self._n_obs_steps)
        images = {key: self._images(batch, rows, key, augment) for key in self._cameras}
        return {**images, **gathered, ROW: rows}

    def _images(self, batch: Batch, rows: Tensor, key: str, augment: bool) -> Tensor:
        """A camera's normalised frames at `rows`; those that the loader did not deliver are read from disk."""
        normalise = self.memory.normaliser.normalise
        if self._n_obs_steps is not None:
            images = self.history(rows, [key], self._n_obs_steps)[key]
            if augment:
                images = torch.stack([self._augmented(key, history) for history in images])
            return normalise(key, images).to(batch[key])
        exchanged = (rows != batch["index"]).nonzero()[:, 0].tolist()
        images = batch[key].clone() if exchanged else batch[key]
        for position in exchanged:
            image = self._augmented(key, self.image(int(rows[position]), key))
            images[position] = normalise(key, image).to(images)
        return images

    def _augmented(self, key: str, image: Tensor) -> Tensor:
        """A camera's frame or history (..., C, H, W) as the loader delivers it in training: one draw for all of it."""
        if self.image_transforms is None or key in self.memory.dataset.meta.depth_keys:
            return image
        return self.image_transforms(image)

    # ---- single frames ----

    def image(self, row: int, key: str) -> Tensor:
        """A camera's frame (C, H, W) in [0, 1], read from its dataset."""
        start, dataset = self._source(row)
        return dataset[row - start][key]

    def task(self, row: int) -> str:
        """What the episode of a row is about, as its dataset describes it."""
        start, _ = self._source(row)
        return self._tasks[start][row - start]

    def _source(self, row: int) -> tuple[int, LeRobotDataset]:
        """The dataset that holds a row, and the row's number at which it starts."""
        return next(source for source in reversed(self._sources) if source[0] <= row)

    def history(self, rows: Tensor, keys: Sequence[str], n_obs_steps: int) -> Batch:
        """Raw observation histories (B, n_obs_steps, ...) of rows, for a teacher; with the rows' `task`s."""
        raw, offsets = self.raw, torch.arange(1 - n_obs_steps, 1)
        rows = rows.cpu()
        histories: Batch = {"task": [self.task(row) for row in rows.tolist()]}
        for key in keys:
            if key in raw.columns:
                histories[key] = raw.gather(key, rows, offsets)[0]
            else:
                steps = (rows[:, None] + offsets).clamp(min=raw.episode_start[rows, None])  # (B, n_obs)
                images = [torch.stack([self.image(int(step), key) for step in row]) for row in steps]
                histories[key] = torch.stack(images)
        return histories

    def executed_future(
        self, rows: Tensor, keys: Sequence[str], n_steps: int
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What the representation learns from, in the student's normalised space.

        Returns:
            Observations now (B, D), features side by side, the recorded actions (B, n, A) that led to the
            observations n_steps later (B, D), and the mask (B,) that is True where those lie beyond the episode.
        """
        actions, _ = self.table.gather(ACTION, rows, torch.arange(n_steps))
        now, later = [], []
        is_pad = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
        for key in keys:
            values, pad = self.table.gather(key, rows, torch.tensor([0, n_steps]))
            now.append(values[:, 0])
            later.append(values[:, 1])
            is_pad = pad[:, 1]
        return torch.cat(now, dim=1), actions, torch.cat(later, dim=1), is_pad

    @property
    def vector_keys(self) -> list[str]:
        """Low-dimensional observation features."""
        return [key for key in self.memory.keys if key != ACTION]


def _beginnings(dataset: LeRobotDataset, n_dropped: int) -> Tensor:
    """Frames (E,) of every episode that may begin a chunk: all but the last `n_dropped`."""
    starts, ends = (
        torch.as_tensor(dataset.meta.episodes[f"dataset_{side}_index"]) for side in ("from", "to")
    )
    return (ends - starts - n_dropped).clamp(min=0)


def _tasks(dataset: LeRobotDataset) -> list[str]:
    """The task of every frame."""
    names = {int(index): str(name) for name, index in dataset.meta.tasks["task_index"].items()}
    return [names[int(index)] for index in dataset.hf_dataset.with_format("numpy")["task_index"][:]]
