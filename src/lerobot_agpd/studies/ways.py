"""Which way the kept episodes of every round took, in tasks that can be done in several ways."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from scipy.stats import entropy

from lerobot_agpd.envs.base import SimulatedEnvConfig
from lerobot_agpd.envs.ways import WaysTask
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.replay.stored import StoredEpisode


@dataclass(frozen=True)
class RoundWays:
    """Kept episodes of a round on every way.

    Attributes:
        strategy: of the episodes that the strategy decided.
        teacher_only: of those of the teacher alone.
    """

    strategy: list[int]
    teacher_only: list[int]

    @property
    def total(self) -> list[int]:
        """Kept episodes on every way."""
        return [sum(pair) for pair in zip(self.strategy, self.teacher_only, strict=True)]

    @property
    def entropy(self) -> float:
        """Entropy over the ways in nats: 0 if all episodes took one, log(n_ways) if all are alike; NaN without any."""
        return float(entropy(self.total)) if any(self.total) else float("nan")

    def to_json(self) -> dict[str, list[int]]:
        """A JSON object."""
        return asdict(self)


def ways_task(env: EnvConfig) -> WaysTask | None:
    """The task of an environment, if it has several ways."""
    spec = env.spec if isinstance(env, SimulatedEnvConfig) else None
    return spec if isinstance(spec, WaysTask) else None


def way_of(task: WaysTask, episode: StoredEpisode) -> int:
    """Way that a kept episode took.

    Raises:
        KeyError: if the episode holds cameras but no vectors.
    """
    return task.way_of(np.asarray(episode.column(OBS_STATE)), np.asarray(episode.column(OBS_ENV_STATE)))


def ways_of_rounds(root: Path, env: EnvConfig) -> list[RoundWays]:
    """Ways of the kept episodes in a folder of collected episodes, per finished round.

    Returns:
        One entry per round; none if the task has a single way, or if the episodes do not show it.
    """
    task, journal = ways_task(env), EpisodeJournal(root)
    if task is None:
        return []
    rounds = []
    for number in range(len(journal.reports())):
        kept = journal.kept(number)
        if not all({OBS_STATE, OBS_ENV_STATE} <= set(episode.keys) for episode in kept):
            return []
        rounds.append(
            RoundWays(
                strategy=_counts(task, [episode for episode in kept if episode.record.strength > 0]),
                teacher_only=_counts(task, [episode for episode in kept if episode.record.strength == 0]),
            )
        )
    return rounds


def _counts(task: WaysTask, episodes: Sequence[StoredEpisode]) -> list[int]:
    ways = [way_of(task, episode) for episode in episodes]
    return np.bincount(np.array(ways, dtype=int), minlength=task.n_ways).tolist()


def read_ways(entries: Sequence[Mapping[str, Any]]) -> list[RoundWays]:
    """The inverse of `RoundWays.to_json`, for several rounds."""
    return [RoundWays(**entry) for entry in entries]
