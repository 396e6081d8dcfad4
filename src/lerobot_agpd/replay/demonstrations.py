"""The demonstrations in memory, and training batches cut from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.gate import require_finite_frames, require_statistics
from lerobot_agpd.replay.normalization import (
    Normalizer,
    Statistics,
    matching_normalizer,
    saved_statistics,
    training_statistics,
)

Batch = dict[str, Any]


def delivers_single_frames(batch: Mapping[str, Any]) -> bool:
    """Whether a loader's batch holds single frames, (B, A) actions, rather than chunks, (B, H, A)."""
    return batch[ACTION].ndim == 2


def low_dimensional_keys(config: PreTrainedConfig) -> list[str]:
    """Names of the features held in memory: the action and every input that is not an image."""
    inputs = [key for key, ft in (config.input_features or {}).items() if ft.type is not FeatureType.VISUAL]
    return [ACTION, *inputs]


def require_dataset(dataset_meta: LeRobotDatasetMetadata | None) -> LeRobotDatasetMetadata:
    """Refuse to train a policy that was built without a dataset.

    Raises:
        ValueError: if there is none.
    """
    if dataset_meta is None:
        raise ValueError(
            "the batch holds single frames, but the policy was built without dataset_meta and cannot cut chunks "
            "from memory; pass chunks (B, steps, action_dim) or build the policy with make_policy"
        )
    return dataset_meta


class DemonstrationFrames:
    """Demonstration frames in memory, normalized as the training loop normalizes them when they are gathered.

    LeRobotDataset converts every column of every frame that `delta_timestamps` ask for, item by item. With
    low-dimensional data the loader delivers single frames instead, and this class adds what surrounds them:
    episode selection, sampling order, rank shards and exact resume stay the loader's.

    Args:
        config: the policy's configuration (features and normalization).
        dataset_meta: metadata of the training dataset, as `make_policy` passes it.
        dataset_stats: its statistics.
        also_held: further low-dimensional features that are held in memory, those of a teacher that sees other things.

    Attributes:
        keys: the action and the policy's own low-dimensional inputs, which batches hold.
        table: the frames in raw units, on the CPU.

    Raises:
        ValueError: if the policy was built without a dataset.
        FlagError: if the dataset holds values or statistics that are not finite, or no statistics.
    """

    def __init__(
        self,
        config: PreTrainedConfig,
        dataset_meta: LeRobotDatasetMetadata | None,
        dataset_stats: Statistics | None = None,
        also_held: Sequence[str] = (),
    ):
        dataset_meta = require_dataset(dataset_meta)
        self.config = config
        self.keys = low_dimensional_keys(config)
        self.dataset = LeRobotDataset(
            dataset_meta.repo_id,
            root=dataset_meta.root,
            revision=dataset_meta.revision,
            download_videos=False,
        )
        self.table = FrameTable.from_dataset(self.dataset, list(dict.fromkeys([*self.keys, *also_held])))
        self.device = torch.device("cpu")
        self._stats = dataset_stats if dataset_stats is not None else dataset_meta.stats
        require_finite_frames(self.table, dataset_meta.repo_id)
        require_statistics(self._stats, config, self.keys, dataset_meta.repo_id)
        self._normalizer: Normalizer | None = None

    @property
    def knows_normalizer(self) -> bool:
        """Whether a batch was seen."""
        return self._normalizer is not None

    @property
    def normalizer(self) -> Normalizer:
        """The normalizer of the running training loop.

        Raises:
            RuntimeError: before the first batch was seen.
        """
        if self._normalizer is None:
            raise RuntimeError("no batch was seen yet: the loop's statistics are unknown")
        return self._normalizer

    def observe(self, batch: Mapping[str, Tensor]) -> None:
        """Find the statistics in use, and the device, from a batch of single frames; later calls do nothing.

        Raises:
            ValueError: if no available statistics explain the batch.
        """
        if self._normalizer is not None:
            return
        index, columns = batch["index"].cpu(), self.table.columns
        raw = {key: columns[key][index] for key in self.keys}
        # LeRobot takes a batch (B,) of features of one number for a single vector, and makes it (1, B).
        delivered = {key: batch[key].reshape(values.shape) for key, values in raw.items()}
        self._normalizer = matching_normalizer(self.config, self._candidates(), raw, delivered)
        self.device = batch[ACTION].device

    def gather(self, key: str, index: Tensor, delta_indices: Tensor) -> tuple[Tensor, Tensor]:
        """What `FrameTable.gather` delivers, in the policy's units and on the device of the first batch."""
        values, is_pad = self.table.gather(key, index, delta_indices)
        return self.normalizer.normalize(key, values).to(self.device), is_pad.to(self.device)

    def gather_batch(
        self, index: Tensor, chunk_delta_indices: Sequence[int], history_length: int | None
    ) -> Batch:
        """A batch as a policy's forward expects it, images aside.

        Args:
            index: (B,) frames of the current observations.
            chunk_delta_indices: H steps of the action chunk relative to the current one.
            history_length: number of observations; None leaves the time dimension out, as LeRobot's loader does
                for policies that ask for no history.

        Returns:
            Observations (B, history_length, D) or (B, D), `action` (B, H, A) and `action_is_pad` (B, H).
        """
        batch: Batch = {}
        history = torch.arange(1 - (history_length or 1), 1)
        for key in self.keys:
            if key == ACTION:
                chunk = self.gather(ACTION, index, torch.as_tensor(chunk_delta_indices))
                batch[ACTION], batch["action_is_pad"] = chunk
            else:
                values, _ = self.gather(key, index, history)
                batch[key] = values[:, 0] if history_length is None else values
        return batch

    def _candidates(self) -> list[tuple[str, Statistics]]:
        candidates: list[tuple[str, Statistics]] = []
        if self.config.pretrained_path:
            saved = saved_statistics(self.config.pretrained_path, self.config)
            if saved:
                candidates.append(("checkpoint's", saved))
        if self._stats:
            floored = training_statistics(self.config, self._stats)
            candidates += [("dataset's floored", floored), ("dataset's", self._stats)]
        return [*candidates, ("absent", {})]  # a loop without normalization
