"""Seeds of collection: an episode's follow from run, round and its number; disjoint from evaluation's."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from lerobot_agpd.config import COLLECTION_SEEDS
from lerobot_agpd.replay.episode import EpisodeRecord, EpisodeSpec

TEACHER_NOISE_STREAM = 1
"""Random numbers of a round: the teacher's sampling noise, ..."""

STUDENT_NOISE_STREAM = 2
"""... the noise that students draw from torch's own generator, ..."""

DIAGNOSTICS_STREAM = 3
"""... and those of the diagnostics."""

EPISODE_STREAM = 1
"""What varies an episode, beside what the environment draws from the same seed."""

ROLLIN_FRACTION = 0.5
"""strategy=rollin: the student's part is drawn up to this fraction of the longest possible episode."""


def stream_seed(seed: int, rank: int, round_number: int, stream: int) -> int:
    """Seed of one stream of random numbers of a process in a round; streams are independent of each other."""
    state = np.random.SeedSequence([seed, rank, round_number, stream]).generate_state(1, np.uint32)
    return int(state[0])


def episode_specs(
    n_episodes: int,
    seed: int,
    round_number: int,
    strength: float,
    teacher_only_fraction: float,
    student_begins: bool = False,
    retries: Sequence[int] = (),
) -> list[EpisodeSpec]:
    """The episodes of a round, whatever the number of processes that share it.

    Environment seeds come from SeedSequence([seed, 0, round]); teacher-only episodes are spread evenly over the
    round. What else differs between episodes comes from their own seeds.

    Args:
        n_episodes: of the round, over all processes.
        seed: of the run.
        round_number: of the round.
        strength: pull, guidance scale or mixing weight.
        teacher_only_fraction: fraction of the episodes whose strength is 0.
        student_begins: whether the student acts for a first part of every episode.
        retries: environment seeds from which episodes start again. They take the places of the first ones that are
            not the teacher's alone; every round varies them anew.
    """
    # The 0 was the rank while processes drew for themselves; runs of one process keep their seeds.
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0, round_number]))
    seeds = rng.integers(*COLLECTION_SEEDS, size=n_episodes)
    teacher_only = np.diff(np.floor(np.arange(n_episodes + 1) * teacher_only_fraction + 1e-9)) > 0
    waiting = iter(retries)
    specs = []
    for number, (fresh, alone) in enumerate(zip(seeds, teacher_only, strict=True)):
        again = None if alone else next(waiting, None)
        env_seed = int(fresh) if again is None else again
        own = np.random.default_rng([env_seed, EPISODE_STREAM, *([] if again is None else [round_number])])
        own.uniform()  # keeps the numbers that follow where they were when episodes also varied their strength
        fraction = ROLLIN_FRACTION * own.uniform() if student_begins else 0.0
        specs.append(
            EpisodeSpec(number, env_seed, 0.0 if alone else strength, float(fraction), again is not None)
        )
    return specs


def rank_part(
    specs: Sequence[EpisodeSpec], done: Collection[int], rank: int, n_ranks: int
) -> list[EpisodeSpec]:
    """The missing episodes of a round that one process collects: equal parts, to within one episode.

    Args:
        specs: all episodes of the round.
        done: numbers of those that are in the journal, whichever process collected them.
        rank: of the process.
        n_ranks: number of processes, which may differ from when the round was begun.
    """
    missing = [spec for spec in specs if spec.number not in done]
    size, rest = divmod(len(missing), n_ranks)
    first = rank * size + min(rank, rest)
    return missing[first : first + size + (rank < rest)]


def failed_starts(records: Iterable[EpisodeRecord]) -> list[int]:
    """Environment seeds from which no episode has succeeded, the least often tried first.

    A filter on success thins out the starts at which the teacher fails, and with them what the student is taught
    about them; trying these again brings them back.

    Args:
        records: of every episode of the finished rounds.
    """
    attempts: dict[int, int] = {}
    solved = set()
    for record in records:
        attempts[record.seed] = attempts.get(record.seed, 0) + 1
        if (
            record.success or record.solved_at_start or record.invalid
        ):  # the environment's fault, not the teacher's
            solved.add(record.seed)
    return sorted((seed for seed in attempts if seed not in solved), key=lambda seed: attempts[seed])
