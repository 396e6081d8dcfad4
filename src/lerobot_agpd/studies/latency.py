"""Measure the time of one action chunk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

from lerobot_agpd.stopwatch import call_times
from lerobot_agpd.weights import acting_parameters


@dataclass(frozen=True)
class Latency:
    """Time of one batch of action chunks, in milliseconds, and the acting network's size."""

    median_ms: float
    p95_ms: float
    n_parameters: int
    threads: int


def chunk_latency(
    policy: PreTrainedPolicy, batch_size: int = 1, repeats: int = 50, warmup: int = 3
) -> Latency:
    """Time `predict_action_chunk` on random observations.

    Args:
        policy: in evaluation mode.
        batch_size: observations per call.
        repeats: timed calls.
        warmup: calls before those.
    """
    batch = random_observations(policy, batch_size)

    def predict() -> None:
        policy.reset()
        policy.predict_action_chunk(dict(batch))

    times = call_times(predict, repeats, warmup)
    return Latency(
        median_ms=float(np.median(times)),
        p95_ms=float(np.quantile(times, 0.95)),
        n_parameters=acting_parameters(policy),
        threads=torch.get_num_threads(),
    )


def random_observations(policy: PreTrainedPolicy, batch_size: int) -> dict[str, torch.Tensor]:
    """Draw normalized observations for `predict_action_chunk`, with a history for diffusion policies."""
    config = policy.config
    batch = {
        key: torch.randn(batch_size, *feature.shape, device=config.device)
        for key, feature in (config.input_features or {}).items()
    }
    if isinstance(config, DiffusionConfig):
        batch = {
            key: value[:, None].expand(-1, config.n_obs_steps, *value.shape[1:])
            for key, value in batch.items()
        }
    return batch
