"""The replay T during training: demonstrations plus every kept episode."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.replay.backgrounds import replace_backgrounds
from lerobot_agpd.replay.demonstrations import Batch, DemonstrationFrames
from lerobot_agpd.replay.frame_features import FrameFeatures
from lerobot_agpd.replay.frames import ChunkStarts
from lerobot_agpd.replay.gate import FarValues
from lerobot_agpd.replay.images import RecordedFrames, as_floats
from lerobot_agpd.replay.stored import StoredEpisode
from lerobot_agpd.textures import Textures, mask_of

logger = logging.getLogger(__name__)

FRAME_INDEX = "agpd.frame_index"
"""Batch key of each frame's number in T: demonstrations first, under the dataset's own frame index."""


class BatchConfig(Protocol):
    """What the replay reads of a student's configuration.

    Attributes:
        chunk_delta_indices: steps of a chunk relative to the current one.
        history_length: number of observations; None: one, without a time dimension.
        image_features: the cameras.
    """

    @property
    def chunk_delta_indices(self) -> Sequence[int]: ...  # noqa: D102

    @property
    def history_length(self) -> int | None: ...  # noqa: D102

    @property
    def image_features(self) -> Iterable[str]: ...  # noqa: D102


@dataclass(frozen=True)
class ExecutedFuture:
    """What recorded actions led to, in the student's normalized space.

    Attributes:
        observation: (B, D) now, features side by side.
        actions: (B, n, A) recorded.
        later: (B, D) n steps later.
        is_pad: (B,) bool, True where that lies beyond the episode.
    """

    observation: Tensor
    actions: Tensor
    later: Tensor
    is_pad: Tensor


class Replay:
    """Append-only replay buffer T.

    The loader decides which demonstration frames are delivered; a fraction of them is exchanged for frames of
    collected episodes. Episodes that the loader never delivers (left out by `--dataset.episodes`, or held out)
    are never used. The columns of collected episodes follow those of the demonstrations in the same table.

    Args:
        demonstrations: their frames; the table grows by the collected ones.
        config: the student's configuration.
        collected_fraction: fraction of every batch that is exchanged; None draws uniformly from T.
        image_transforms: what the loader applies to training images (..., C, H, W) in [0, 1]; T applies it to those
            that it reads itself.
        backgrounds: of training images; None: those that were recorded.
    """

    def __init__(
        self,
        demonstrations: DemonstrationFrames,
        config: BatchConfig,
        collected_fraction: float | None,
        image_transforms: Callable[[Tensor], Tensor] | None = None,
        backgrounds: Textures | None = None,
    ):
        self.demonstrations = demonstrations
        self.table = demonstrations.table
        self.frames = RecordedFrames(demonstrations.dataset, self.table)
        self.config = config
        self.image_transforms, self.backgrounds = image_transforms, backgrounds
        self._far_values = FarValues()
        self.n_demonstration_frames = len(self.table)
        self.seen_episodes: set[int] = set()
        n_dropped: int = getattr(config, "drop_n_last_frames", 0)  # ACT has no such setting
        self._fixed_fraction = collected_fraction
        self._demonstrated_starts = (self.table.lengths - n_dropped).clamp(min=0)  # (E,)
        self._collected_starts = ChunkStarts(n_dropped)
        self._n_seen_starts = 0  # frames of seen episodes that may begin a chunk
        self._cameras = list(config.image_features)

    # ---- contents ----

    @property
    def n_collected_frames(self) -> int:
        """Frames of kept episodes."""
        return len(self.table) - self.n_demonstration_frames

    def extend(self, episodes: Iterable[StoredEpisode]) -> None:
        """Append kept episodes: their columns, and as many of their camera frames as fit, to memory.

        Raises:
            KeyError: if an episode lacks one of the features in memory.
            ValueError: if an episode is damaged.
        """
        n_starts, n_frames = len(self._collected_starts), len(self.table)
        for episode in episodes:
            first, keys = len(self.table), list(self.table.columns)
            self.table.append({key: _column(episode, key) for key in keys}, [len(episode)])
            self.frames.append(episode)
            self._collected_starts.append(first, len(episode))
        if self.demonstrations.knows_normalizer:
            for key in self.demonstrations.keys:
                values = self.table.columns[key][n_frames:]
                normalized = self.demonstrations.normalizer.normalize(key, values)
                self._far_values.check("the new episodes", key, normalized)
        if len(self.table) > n_frames and len(self._collected_starts) == n_starts:
            logger.warning(
                "none of the new episodes is longer than --policy.drop_n_last_frames=%d: none is trained on",
                self._collected_starts.n_dropped,
            )

    # ---- batches ----

    def observe(self, batch: Batch) -> None:
        """Note the statistics and the episodes of a batch that the loader delivers in training."""
        self.demonstrations.observe(batch)
        self.see(batch["episode_index"].tolist())

    def see(self, episodes: Iterable[int]) -> None:
        """Note demonstrations that the loader delivers in training."""
        new = sorted(set(episodes) - self.seen_episodes)
        if new:
            self.seen_episodes.update(new)
            self._n_seen_starts += int(self._demonstrated_starts[new].sum())

    @property
    def collected_fraction(self) -> float:
        """Fraction of a batch that collected frames fill."""
        n_collected = len(self._collected_starts)
        if n_collected == 0:
            return 0.0
        if self._fixed_fraction is not None:
            return self._fixed_fraction
        # Uniform over the frames that begin a chunk: on both sides, an episode's dropped ones do not count.
        return n_collected / (self._n_seen_starts + n_collected)

    def train_batch(self, batch: Batch, generator: torch.Generator) -> Batch:
        """A batch of T for a training step: the loader's frames, a fraction exchanged for collected ones."""
        frame_index = batch["index"].clone()
        exchanged = torch.rand(len(frame_index), generator=generator) < self.collected_fraction
        n_exchanged = int(exchanged.sum())
        if n_exchanged:
            positions = torch.randint(len(self._collected_starts), (n_exchanged,), generator=generator)
            drawn = self._collected_starts.frames(positions)
            frame_index[exchanged.to(frame_index.device)] = drawn.to(frame_index)
        rng = np.random.default_rng(int(torch.randint(2**31, (), generator=generator)))
        return self._gather(batch, frame_index, rng)

    def starts(self) -> Tensor:
        """Frames that begin a chunk: those of the seen demonstrations, then the collected ones."""
        seen = torch.tensor(sorted(self.seen_episodes), dtype=torch.long)
        counts, ends = self._demonstrated_starts[seen], self.table.lengths.cumsum(0)[seen]
        first = (ends - self.table.lengths[seen]).repeat_interleave(counts)
        before = (counts.cumsum(0) - counts).repeat_interleave(counts)
        demonstrated = first + torch.arange(len(first)) - before
        return torch.cat(
            [demonstrated, self._collected_starts.frames(torch.arange(len(self._collected_starts)))]
        )

    def batch_at(self, frame_index: Tensor) -> Batch:
        """A batch of given frames, read from memory and disk."""
        length, device = self.config.history_length, self.demonstrations.device
        gathered = self.demonstrations.gather_batch(frame_index, self.config.chunk_delta_indices, length)
        images = self.frames.images(frame_index, self._cameras, length) if self._cameras else {}
        like = torch.empty(0, device=device)
        gathered |= {
            key: self._normalized(key, values, like, augment=False) for key, values in images.items()
        }
        return {**gathered, FRAME_INDEX: frame_index.to(device)}

    def eval_batch(self, batch: Batch) -> Batch:
        """The loader's frames with their chunks, for a held-out loss."""
        self.demonstrations.observe(batch)
        return self._gather(batch, batch["index"])

    def _gather(self, batch: Batch, frame_index: Tensor, rng: np.random.Generator | None = None) -> Batch:
        gathered = self.demonstrations.gather_batch(
            frame_index, self.config.chunk_delta_indices, self.config.history_length
        )
        images = self._images(batch, frame_index, rng)
        return {**images, **gathered, FRAME_INDEX: frame_index}

    def _images(self, batch: Batch, frame_index: Tensor, rng: np.random.Generator | None) -> Batch:
        """Normalized camera frames; those that the loader did not deliver are T's own.

        In training, where there is an `rng`, they are augmented: transformed, and before other backgrounds.
        """
        if not self._cameras:
            return {}
        augment, n_obs_steps = rng is not None, self.config.history_length
        if rng is not None and self.backgrounds is not None:
            keys = [*self._cameras, *map(mask_of, self._cameras)]
            read = self.frames.images(frame_index, keys, n_obs_steps)
            for key in self._cameras:
                read[key] = replace_backgrounds(read[key], read[mask_of(key)], self.backgrounds, rng)
            return {key: self._normalized(key, read[key], batch[key], augment) for key in self._cameras}
        if n_obs_steps is not None:
            read = self.frames.images(frame_index, self._cameras, n_obs_steps)
            return {key: self._normalized(key, read[key], batch[key], augment) for key in self._cameras}
        images = {key: batch[key] for key in self._cameras}
        exchanged = frame_index != batch["index"]
        if exchanged.any():
            read = self.frames.images(frame_index[exchanged], self._cameras)
            for key in self._cameras:
                images[key] = images[key].clone()
                images[key][exchanged] = self._normalized(key, read[key], images[key], augment)
        return images

    def _normalized(self, key: str, images: Tensor, like: Tensor, augment: bool) -> Tensor:
        """A camera's frames or histories (B, ..., C, H, W), normalized; each gets one draw of the transforms.

        They stay uint8, a quarter of the size, until they are on the device of `like`.
        """
        images = as_floats(images.to(like.device))
        is_depth = key in self.demonstrations.dataset.meta.depth_keys
        if augment and self.image_transforms is not None and not is_depth:
            images = torch.stack([self.image_transforms(image) for image in images])
        return self.demonstrations.normalizer.normalize(key, images).to(like)

    # ---- observations of frames ----

    def history(self, frame_index: Tensor, keys: Sequence[str], n_obs_steps: int) -> Batch:
        """Raw observation histories (B, n_obs_steps, ...) of frames, for a teacher; with the frames' `task`s."""
        return self.frames.history(frame_index, keys, n_obs_steps)

    def executed_future(self, frame_index: Tensor, keys: Sequence[str], n_steps: int) -> ExecutedFuture:
        """What the representation learns from, for frames (B,) and vectors `keys`."""
        observed = [
            self.demonstrations.gather(key, frame_index, torch.tensor([0, n_steps]))[0] for key in keys
        ]
        now, later = (torch.cat([values[:, step] for values in observed], dim=1) for step in (0, 1))
        return ExecutedFuture(now, *self._executed(frame_index, n_steps, later))

    def visual_future(self, frame_index: Tensor, features: FrameFeatures, n_steps: int) -> ExecutedFuture:
        """The same with the features of camera frames."""
        index = frame_index.cpu()
        _, ends = self.table.episode_bounds(index)
        later = features.at(torch.minimum(index + n_steps, ends - 1))
        return ExecutedFuture(features.at(index), *self._executed(frame_index, n_steps, later))

    def _executed(self, frame_index: Tensor, n_steps: int, later: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        actions, is_pad = self.demonstrations.gather(ACTION, frame_index, torch.arange(n_steps + 1))
        return actions[:, :n_steps], later, is_pad[:, n_steps]


def _column(episode: StoredEpisode, key: str) -> Tensor:
    """A feature's values (T, D) in memory."""
    values = np.array(episode.column(key), dtype=np.float32)
    return torch.from_numpy(values).reshape(len(episode), -1)
