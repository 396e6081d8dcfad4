"""Seeds of collection: reproducible per process and round, disjoint from evaluation's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_agpd.collect.config import COLLECTION_SEEDS
from lerobot_agpd.replay.episode import Ticket

VARIATION = 1
"""Stream of the random numbers that vary an episode, beside those the environment draws from the same seed."""


def round_tickets(
    n_episodes: int,
    seed: int,
    rank: int,
    n_ranks: int,
    round_number: int,
    scale: float,
    unguided_fraction: float,
    scale_spread: float = 1.0,
    max_student_share: float = 0.0,
    retries: Sequence[int] = (),
) -> list[Ticket]:
    """The episodes of a round of n_episodes that one process collects.

    Environment seeds come from SeedSequence([seed, rank, round]); unguided episodes are spread evenly over the
    round, whatever the number of processes. What else differs between episodes comes from their own seeds.

    Args:
        n_episodes: of the round, over all processes.
        seed: of the run.
        rank: of this process.
        n_ranks: number of processes.
        round_number: of the round.
        scale: guidance scale, or mixing weight.
        unguided_fraction: share of the episodes whose scale is 0.
        scale_spread: the others' scales are log-uniform in [scale / scale_spread, scale * scale_spread].
        max_student_share: the student's shares of the episodes are uniform in [0, max_student_share).
        retries: environment seeds from which episodes start again. They take the places of the first ones that the
            strategy decides; every round varies them anew.
    """
    first = sum(share_of(n_episodes, lower, n_ranks) for lower in range(rank))
    n_episodes = share_of(n_episodes, rank, n_ranks)
    rng = np.random.default_rng(np.random.SeedSequence([seed, rank, round_number]))
    seeds = rng.integers(*COLLECTION_SEEDS, size=n_episodes)
    unguided = np.diff(np.floor((first + np.arange(n_episodes + 1)) * unguided_fraction + 1e-9)) > 0
    waiting = iter(retries)
    tickets = []
    for number, (fresh, alone) in enumerate(zip(seeds, unguided, strict=True)):
        again = None if alone else next(waiting, None)
        env_seed = int(fresh) if again is None else again
        own = np.random.default_rng([env_seed, VARIATION, *([] if again is None else [round_number])])
        spread, share = scale_spread ** own.uniform(-1, 1), own.uniform(0, 1)
        drawn = 0.0 if alone else float(scale * spread)
        tickets.append(
            Ticket(number, env_seed, drawn, float(max_student_share * share), retry=again is not None)
        )
    return tickets


def failed_starts(reports: Sequence[Mapping[str, Any]]) -> list[int]:
    """Environment seeds from which no episode has succeeded, the least often tried first.

    A filter on success thins out the starts at which the teacher fails, and with them what the student is taught
    about them; trying these again brings them back.

    Args:
        reports: of the finished rounds, with a record of every episode.
    """
    tried: dict[int, int] = {}
    solved = set()
    for record in (record for report in reports for record in report["episodes"]):
        tried[record["seed"]] = tried.get(record["seed"], 0) + 1
        if record["passed"] or record["trivial"]:
            solved.add(record["seed"])
    return sorted((seed for seed in tried if seed not in solved), key=lambda seed: tried[seed])


def share_of(n_episodes: int, rank: int, n_ranks: int) -> int:
    """How many of a round's episodes a process collects."""
    return n_episodes // n_ranks + (rank < n_episodes % n_ranks)


def noise_seed(seed: int, rank: int, round_number: int, stream: int = 1) -> int:
    """Seed of a process's sampling noise in a round; streams are independent of each other."""
    state = np.random.SeedSequence([seed, rank, round_number, stream]).generate_state(1, np.uint32)
    return int(state[0])
