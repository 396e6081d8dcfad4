"""Training rows cut from memory: the loader names frames, the gather delivers chunks and histories."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.normalisation import (
    Normaliser,
    Statistics,
    floor_statistics,
    matching_normaliser,
    saved_statistics,
)

logger = logging.getLogger(__name__)

Batch = dict[str, Any]


def delivers_single_frames(batch: Mapping[str, Any]) -> bool:
    """Whether a loader's batch holds single frames, (B, A) actions, rather than chunks, (B, H, A)."""
    return batch[ACTION].ndim == 2


def low_dimensional_keys(config: PreTrainedConfig) -> list[str]:
    """Names of the features held in memory: the action and every input that is not an image."""
    inputs = [key for key, ft in (config.input_features or {}).items() if ft.type is not FeatureType.VISUAL]
    return [ACTION, *inputs]


class FrameMemory:
    """Demonstration frames in memory, normalised as the training loop normalises them.

    LeRobotDataset converts every column of every row that `delta_timestamps` ask for, item by item. With
    low-dimensional data the loader is asked for single frames instead, and this class adds what surrounds
    them: episode selection, sampling order, rank shards and exact resume stay the loader's.

    Args:
        config: the policy's configuration (features and normalisation).
        dataset_meta: metadata of the training dataset, as `make_policy` passes it.
        dataset_stats: its statistics.

    Raises:
        ValueError: if the policy was built without a dataset.
    """

    def __init__(
        self,
        config: PreTrainedConfig,
        dataset_meta: LeRobotDatasetMetadata | None,
        dataset_stats: Statistics | None = None,
    ):
        if dataset_meta is None:
            raise ValueError(
                "the batch holds single frames, but the policy was built without dataset_meta and cannot cut chunks "
                "from memory; pass chunks (B, steps, action_dim) or build the policy with make_policy"
            )
        self.config = config
        self.keys = low_dimensional_keys(config)
        self.dataset = LeRobotDataset(
            dataset_meta.repo_id,
            root=dataset_meta.root,
            revision=dataset_meta.revision,
            download_videos=False,
        )
        self.table = FrameTable.from_dataset(self.dataset, self.keys)  # raw units
        self._stats = dataset_stats if dataset_stats is not None else dataset_meta.stats
        self._normaliser: Normaliser | None = None
        self._normalised: FrameTable | None = None

    @property
    def is_ready(self) -> bool:
        """Whether the statistics are known, which takes the first batch."""
        return self._normaliser is not None

    @property
    def normaliser(self) -> Normaliser:
        """The normaliser of the running training loop.

        Raises:
            RuntimeError: before the first batch was seen.
        """
        if self._normaliser is None:
            raise RuntimeError("no batch was seen yet: the loop's statistics are unknown")
        return self._normaliser

    @property
    def normalised(self) -> FrameTable:
        """The table in the policy's units, on the device of the first batch."""
        if self._normalised is None:
            raise RuntimeError("no batch was seen yet: the loop's statistics are unknown")
        return self._normalised

    def observe(self, batch: Mapping[str, Tensor]) -> None:
        """Find the statistics in use from a batch of single frames; later calls do nothing.

        Raises:
            ValueError: if no known statistics explain the batch.
        """
        if self.is_ready:
            return
        index = batch["index"].cpu()
        raw = {key: self.table.columns[key][index] for key in self.keys}
        self._normaliser = matching_normaliser(self.config, self._candidates(), raw, batch)
        device = batch[ACTION].device
        self._normalised = self.normalise(self.table, device)

    def normalise(self, table: FrameTable, device: torch.device) -> FrameTable:
        """A table of raw frames in the policy's units, on `device`."""
        columns = {key: self.normaliser.normalise(key, table.columns[key]).to(device) for key in self.keys}
        return FrameTable(columns, table.episode_start.to(device), table.episode_end.to(device))

    def _candidates(self) -> list[tuple[str, Statistics]]:
        candidates: list[tuple[str, Statistics]] = []
        if self.config.pretrained_path:
            saved = saved_statistics(self.config.pretrained_path, self.config)
            if saved:
                candidates.append(("checkpoint's", saved))
        if self._stats:
            candidates += [("dataset's floored", floor_statistics(self._stats)), ("dataset's", self._stats)]
        return [*candidates, ("absent", {})]  # a loop without normalisation


def gather_rows(
    table: FrameTable,
    index: Tensor,
    config: PreTrainedConfig,
    action_offsets: Tensor,
    n_obs_steps: int | None,
) -> Batch:
    """Rows of a table as a policy's forward wants them.

    Args:
        table: normalised frames.
        index: (B,) rows of the current observations.
        config: names the features.
        action_offsets: (H,) steps of the action chunk relative to the current one.
        n_obs_steps: length of the observation history; None leaves the time dimension out, as LeRobot's loader
            does for policies that ask for no history.

    Returns:
        Observations (B, n_obs_steps, D) or (B, D), `action` (B, H, A) and `action_is_pad` (B, H).
    """
    rows: Batch = {}
    history = torch.arange(1 - (n_obs_steps or 1), 1)
    for key in low_dimensional_keys(config):
        if key == ACTION:
            rows[ACTION], rows["action_is_pad"] = table.gather(ACTION, index, action_offsets)
        elif key in table.columns:
            values, _ = table.gather(key, index, history)
            rows[key] = values[:, 0] if n_obs_steps is None else values
    return rows
