"""Measure what collection strategies do to actions and states over a range of strengths (Theorem 3.3, on real rollouts).

The paper argues with the diversity of *actions*; for a fixed student chunk both guidance and mixing shrink it. What
can grow is the variety of *states* that episodes visit, so this is measured here, together with how well the states
of the student's own rollouts are covered.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors
from lerobot.utils.random_utils import seeded_context

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.guidance.teacher import History
from lerobot_agpd.replay.episode import Array, Episode, EpisodeSpec
from lerobot_agpd.replay.normalization import Statistics
from lerobot_agpd.rollout.diagnostics import (
    EPSILON,
    MAX_STATES,
    NEIGHBOR,
    action_diagnostics,
    at_most,
    state_path,
)
from lerobot_agpd.rollout.diversity import knn_entropy, state_coverage
from lerobot_agpd.rollout.report import Tally, success_rate
from lerobot_agpd.rollout.rollout import Decision, Rollouts
from lerobot_agpd.rollout.strategies import Strategy
from lerobot_agpd.rollout.success import classify

SettingName = Literal["teacher", "guided", "interpolate", "switch"]


@dataclass(frozen=True)
class Setting:
    """A strategy at a strength: `teacher`, `guided` (guidance scale), `interpolate` or `switch` (lambda)."""

    strategy: SettingName
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


def configured(student_config: StudentConfig, setting: Setting) -> StudentConfig:
    """The student's configuration with one setting's strategy."""
    config = deepcopy(student_config)
    if setting.strategy == "teacher" or setting.strategy == "guided":
        config.collect.strategy = setting.strategy
        config.guidance = replace(config.guidance, pull=None, scale=setting.strength)
    else:
        config.collect.strategy, config.collect.mixing.form = "mixing", setting.strategy
    return config


@dataclass(frozen=True)
class Sweep:
    """Measure settings against each other: same environment seeds, same observations, same numbers of states.

    Attributes:
        student_config: the student's configuration; its `collect` group filters.
        env_config: the environment.
        stats: statistics that standardize states.
        seeds: environment seeds of every setting's episodes.
        noise_seed: of all sampling.
    """

    student_config: StudentConfig
    env_config: EnvConfig
    stats: Statistics
    seeds: Sequence[int]
    noise_seed: int

    def episodes(
        self,
        strategy: Strategy,
        setting: Setting,
        on_decision: Callable[[Decision], None] | None = None,
    ) -> list[Episode]:
        """All episodes of a setting, in the order of the seeds."""
        tasks = make_env(self.env_config, n_envs=min(self.student_config.collect.n_envs, len(self.seeds)))
        processors = make_env_pre_post_processors(self.env_config, self.student_config)
        specs = [EpisodeSpec(number, seed, setting.strength) for number, seed in enumerate(self.seeds)]
        try:
            envs = next(iter(next(iter(tasks.values())).values()))
            with torch.no_grad(), seeded_context(self.noise_seed):
                episodes = list(Rollouts(envs, processors, strategy, on_decision).run(specs))
        finally:
            close_envs(tasks)
        return sorted(episodes, key=lambda episode: episode.spec.number)

    def measure(
        self,
        setting: Setting,
        strategy: Strategy,
        episodes: Sequence[Episode],
        history: History,
        student_states: Array,
    ) -> SweepRow:
        """Compare one setting's episodes with the student's.

        Args:
            setting: the setting.
            strategy: of the setting.
            episodes: of the setting.
            history: observations (B, T, ...) at which actions are compared.
            student_states: (M, D) states of the student's own rollouts, standardized.
        """
        records = [classify(episode, self.student_config.collect) for episode in episodes]
        kept = [episode for episode, record in zip(episodes, records, strict=True) if record.kept]
        with torch.no_grad(), seeded_context(self.noise_seed):
            actions = action_diagnostics(strategy, history, setting.strength, self.noise_seed)
        kept_states = self.states(kept) if kept else None
        radius = EPSILON * student_states.shape[1] ** 0.5
        return SweepRow(
            setting=setting,
            success=success_rate([Tally.of(records)]) or 0.0,
            kept=len(kept),
            actions=actions,
            entropy=self.entropy(self.states(episodes)),
            entropy_kept=None if kept_states is None else self.entropy(kept_states),
            coverage=0.0 if kept_states is None else state_coverage(student_states, kept_states, radius),
        )

    def states(self, episodes: Sequence[Episode]) -> Array:
        """Standardized states of episodes, (N, D)."""
        return np.concatenate([state_path(episode.observations, self.stats) for episode in episodes])

    def entropy(self, states: Array) -> float | None:
        """Entropy of at most MAX_STATES of them, chosen at random; None if there are too few."""
        distinct = at_most(MAX_STATES, np.unique(states, axis=0), np.random.default_rng(self.noise_seed))
        return knn_entropy(distinct, NEIGHBOR) if len(distinct) > NEIGHBOR else None
