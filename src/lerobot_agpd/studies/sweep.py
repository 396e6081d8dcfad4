"""Measure what collection strategies do to actions and states over a range of strengths (Theorem 3.3, on real rollouts).

The paper argues with the diversity of *actions*; for a fixed student chunk both guidance and mixing shrink it. What
can grow is the variety of *states* that episodes visit, so this is measured here, together with how well the states
of the student's own rollouts are covered.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors
from lerobot.utils.random_utils import seeded_context

from lerobot_agpd.collect.config import VariationConfig
from lerobot_agpd.collect.decider import Decider
from lerobot_agpd.collect.diagnostics import action_diagnostics, state_path
from lerobot_agpd.collect.rollout import Rollouts
from lerobot_agpd.collect.success import SuccessFilter
from lerobot_agpd.replay.episode import Array, Episode, Ticket
from lerobot_agpd.replay.normalisation import Statistics
from lerobot_agpd.studies.diversity import knn_entropy, state_coverage

CORE_NAMES = {"teacher": "replay"}
"""Strategies that `collect.strategy` calls otherwise."""


@dataclass(frozen=True)
class Setting:
    """A strategy at a strength: `teacher`, `guided` (guidance scale), `interpolate` or `switch` (lambda)."""

    strategy: str
    strength: float = 0.0


@dataclass(frozen=True)
class SweepRow:
    """Measurements of one setting.

    Attributes:
        setting: the strategy and its strength.
        success: rate among the episodes that were not solved at the start.
        kept: number of kept episodes.
        actions: `action_diagnostics` at the same observations for all settings.
        entropy: nearest-neighbor entropy of the states of all episodes, in nats, equal numbers of states for all.
        entropy_kept: the same of the kept episodes; None, as above, for too few states.
        coverage: fraction of the student's own states with a state of a kept episode within epsilon.
    """

    setting: Setting
    success: float
    kept: int
    actions: dict[str, float]
    entropy: float | None
    entropy_kept: float | None
    coverage: float

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def configured(policy_config: Any, setting: Setting) -> Any:
    """The student's configuration with one setting's strategy, without variations of guidance."""
    config = deepcopy(policy_config)
    mixing = setting.strategy in ("interpolate", "switch")
    config.collect.strategy = "mixing" if mixing else CORE_NAMES.get(setting.strategy, setting.strategy)
    config.collect.mixing.form = setting.strategy if mixing else config.collect.mixing.form
    config.collect.variation = VariationConfig()
    return config


def roll_out(
    env_config: EnvConfig, policy_config: Any, decider: Decider, strength: float, seeds: Sequence[int]
) -> list[Episode]:
    """Episodes from given environment seeds, in their order."""
    tasks = make_env(env_config, n_envs=min(policy_config.collect.n_envs, len(seeds)))
    processors = make_env_pre_post_processors(env_config, policy_config)
    tickets = [Ticket(number, seed, strength) for number, seed in enumerate(seeds)]
    try:
        envs = next(iter(next(iter(tasks.values())).values()))
        episodes = list(Rollouts(envs, processors, decider).run(tickets))
    finally:
        close_envs(tasks)
    return sorted(episodes, key=lambda episode: episode.ticket.number)


class Sweep:
    """Measure settings against each other: same environment seeds, same observations, same numbers of states.

    Args:
        policy_config: the student's configuration; its `collect` group filters and says how much is measured.
        env_config: the environment.
        stats: statistics that standardize states.
        seeds: environment seeds of every setting's episodes.
        noise_seed: of all sampling.
    """

    def __init__(
        self,
        policy_config: Any,
        env_config: EnvConfig,
        stats: Statistics,
        seeds: Sequence[int],
        noise_seed: int,
    ):
        self.policy_config, self.env_config = policy_config, env_config
        self.stats, self.seeds, self.noise_seed = stats, seeds, noise_seed
        self.filter = SuccessFilter.from_config(policy_config.collect)

    def episodes(self, decider: Decider, setting: Setting) -> list[Episode]:
        """All episodes of a setting."""
        with torch.no_grad(), seeded_context(self.noise_seed):
            return roll_out(self.env_config, self.policy_config, decider, setting.strength, self.seeds)

    def measure(
        self, setting: Setting, decider: Any, episodes: Sequence[Episode], history: Any, student_states: Array
    ) -> SweepRow:
        """Compare one setting's episodes with the student's.

        Args:
            setting: the setting.
            decider: its strategy, as a `PairDecider`.
            episodes: its episodes.
            history: observations (B, T, ...) at which actions are compared.
            student_states: (M, D) states of the student's own rollouts, standardized.
        """
        config = self.policy_config.collect.diagnostics
        records = [self.filter.judge(episode) for episode in episodes]
        counted = [record for record in records if not record.trivial]
        kept = [episode for episode, record in zip(episodes, records, strict=True) if record.kept]
        with torch.no_grad(), seeded_context(self.noise_seed):
            actions = action_diagnostics(decider, history, setting.strength, config.samples, self.noise_seed)
        kept_states = self.states(kept) if kept else None
        radius = config.epsilon * student_states.shape[1] ** 0.5
        return SweepRow(
            setting=setting,
            success=sum(record.passed for record in counted) / max(len(counted), 1),
            kept=len(kept),
            actions=actions,
            entropy=self.entropy(self.states(episodes)),
            entropy_kept=None if kept_states is None else self.entropy(kept_states),
            coverage=0.0 if kept_states is None else state_coverage(student_states, kept_states, radius),
        )

    def states(self, episodes: Sequence[Episode]) -> Array:
        """Standardized states of episodes, (N, D)."""
        return np.concatenate([state_path(episode, self.stats) for episode in episodes])

    def entropy(self, states: Array) -> float | None:
        """Entropy of at most `diagnostics.states` of them, chosen at random; None if there are too few."""
        config = self.policy_config.collect.diagnostics
        distinct = np.unique(states, axis=0)
        rng = np.random.default_rng(self.noise_seed)
        if len(distinct) > config.states:
            distinct = distinct[rng.choice(len(distinct), config.states, replace=False)]
        return knn_entropy(distinct, config.neighbours) if len(distinct) > config.neighbours else None
