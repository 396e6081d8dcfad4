"""Seeds of collection: reproducible per process and round, disjoint from evaluation's."""

from __future__ import annotations

import numpy as np

from lerobot_agpd.collect.config import COLLECTION_SEEDS
from lerobot_agpd.replay.episode import Ticket


def round_tickets(
    n_episodes: int,
    seed: int,
    rank: int,
    n_ranks: int,
    round_number: int,
    scale: float,
    unguided_fraction: float,
) -> list[Ticket]:
    """The episodes of a round of n_episodes that one process collects.

    Environment seeds come from SeedSequence([seed, rank, round]); unguided episodes are spread evenly over the
    round, whatever the number of processes.
    """
    first = sum(share_of(n_episodes, lower, n_ranks) for lower in range(rank))
    n_episodes = share_of(n_episodes, rank, n_ranks)
    rng = np.random.default_rng(np.random.SeedSequence([seed, rank, round_number]))
    seeds = rng.integers(*COLLECTION_SEEDS, size=n_episodes)
    unguided = np.diff(np.floor((first + np.arange(n_episodes + 1)) * unguided_fraction + 1e-9)) > 0
    return [
        Ticket(number, int(env_seed), 0.0 if alone else scale)
        for number, (env_seed, alone) in enumerate(zip(seeds, unguided, strict=True))
    ]


def share_of(n_episodes: int, rank: int, n_ranks: int) -> int:
    """How many of a round's episodes a process collects."""
    return n_episodes // n_ranks + (rank < n_episodes % n_ranks)


def noise_seed(seed: int, rank: int, round_number: int) -> int:
    """Seed of a process's sampling noise in a round."""
    state = np.random.SeedSequence([seed, rank, round_number, 1]).generate_state(1, np.uint32)
    return int(state[0])
