"""Collects a round: this process's part of the episodes, in environments side by side."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors
from lerobot.utils.random_utils import seeded_context
from tqdm import tqdm

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.replay.episode import Array, Episode, EpisodeRecord, EpisodeSpec
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.rollout.diagnostics import (
    ObservationReservoir,
    RoundDiagnostics,
    action_diagnostics,
    state_diagnostics,
)
from lerobot_agpd.rollout.rollout import Decision, Rollouts
from lerobot_agpd.rollout.seeds import (
    DIAGNOSTICS_STREAM,
    TEACHER_NOISE_STREAM,
    episode_specs,
    failed_starts,
    rank_part,
    stream_seed,
)
from lerobot_agpd.rollout.strategies import Strategy
from lerobot_agpd.stopwatch import Stopwatch

logger = logging.getLogger(__name__)


class Collector:
    """Rolls out the episodes of rounds with whatever strategy it is given.

    Args:
        config: the student's.
        env_config: the environment.
        demonstrations: metadata of the demonstrations.
        journal: where kept episodes go.
        check: raises if a first observation (vectors (D,), images (H, W, C)) could not be kept.
        seed: of the run.
        rank: of this process.
        n_ranks: number of processes.
    """

    def __init__(
        self,
        config: StudentConfig,
        env_config: EnvConfig,
        demonstrations: LeRobotDatasetMetadata,
        journal: EpisodeJournal,
        check: Callable[[Mapping[str, Array]], None],
        seed: int,
        rank: int,
        n_ranks: int,
    ):
        self.config = config
        self.env_config = env_config
        self.demonstrations = demonstrations
        self.journal = journal
        self.check = check
        self.seed, self.rank, self.n_ranks = seed, rank, n_ranks
        self._reservoir: ObservationReservoir | None = None

    def noise(self, round_number: int) -> torch.Generator:
        """Source of this process's sampling noise in a round."""
        generator = torch.Generator(device=self.config.device or "cpu")
        return generator.manual_seed(self.stream_seed(round_number, TEACHER_NOISE_STREAM))

    def stream_seed(self, round_number: int, stream: int) -> int:
        """Seed of one of this process's streams of random numbers in a round."""
        return stream_seed(self.seed, self.rank, round_number, stream)

    def specs(self, round_number: int, strength: float) -> list[EpisodeSpec]:
        """The episodes of this process's part of a round; the same at every call."""
        collect = self.config.collect
        n_retries = int(collect.retry_fraction * rank_part(collect.episodes, self.rank, self.n_ranks))
        earlier: list[EpisodeRecord] = []
        if n_retries:
            earlier = [record for number in range(round_number) for record in self.journal.records(number)]
        return episode_specs(
            collect.episodes,
            self.seed,
            self.rank,
            self.n_ranks,
            round_number,
            strength,
            collect.teacher_only_fraction,
            student_begins=collect.strategy == "rollin",
            retries=failed_starts(earlier)[self.rank :: self.n_ranks][:n_retries],
        )

    def roll_out(
        self, round_number: int, strength: float, strategy: Strategy, done: Collection[int]
    ) -> Iterator[Episode]:
        """Yield the round's episodes as they finish.

        Args:
            round_number: of the round.
            strength: pull, guidance scale or mixing weight.
            strategy: made for this round; its stopwatch takes the time.
            done: numbers of the episodes that an interrupted round has already collected.
        """
        self._reservoir = None
        if self.config.collect.diagnostics:
            self._reservoir = ObservationReservoir(self.stream_seed(round_number, TEACHER_NOISE_STREAM))
        specs = self.specs(round_number, strength)
        missing = [spec for spec in specs if spec.number not in done]
        if not missing:
            return
        progress = tqdm(
            total=len(specs),
            initial=len(specs) - len(missing),
            desc=f"Collecting round {round_number}",
            unit="episode",
            leave=False,
            disable=self.rank != 0,
        )
        with closing(progress):
            for episode in self._episodes(missing, strategy, self._reservoir):
                progress.update()
                yield episode

    def _episodes(
        self,
        specs: list[EpisodeSpec],
        strategy: Strategy,
        on_decision: Callable[[Decision], None] | None,
    ) -> Iterator[Episode]:
        n_envs = min(self.config.collect.n_envs, len(specs))
        tasks = make_env(self.env_config, n_envs=n_envs, use_async_envs=self.config.collect.use_async_envs)
        environments = [envs for suite in tasks.values() for envs in suite.values()]
        processors = make_env_pre_post_processors(self.env_config, self.config)
        try:
            for position, envs in enumerate(environments):
                rollouts = Rollouts(envs, processors, strategy, on_decision, self.check)
                yield from rollouts.run(specs[position :: len(environments)])
        finally:
            close_envs(tasks)

    def require_valid_episodes(self, round_number: int) -> None:
        """Warn of a round's invalid episodes, of all processes, which have been dropped.

        Raises:
            FloatingPointError: if most of the round's episodes are invalid.
        """
        records = self.journal.records(round_number)
        invalid = [record for record in records if record.invalid]
        if not invalid:
            return
        facts = (
            f"round {round_number}: {len(invalid)} of {len(records)} episodes are dropped because they hold numbers that "
            f"are not finite (first: {invalid[0].invalid}, environment seed {invalid[0].seed}), which come from the "
            f"environment '{self.env_config.type}' (--env.*)"
        )
        if 2 * len(invalid) > len(records):
            raise FloatingPointError(
                f"{facts}. Repair it, delete {self.journal.folder(round_number)} and go on with --resume=true"
            )
        logger.warning(facts)

    @torch.no_grad()
    def diagnose(self, round_number: int, strength: float, strategy: Strategy) -> RoundDiagnostics | None:
        """What the strategy did to actions and states; called on one process when all have finished the round.

        Actions are sampled again where this process has seen `strategy` decide since it started the round;
        states are those of all processes' kept episodes.
        """
        if self._reservoir is None:
            return None
        stopwatch = Stopwatch()
        seed = self.stream_seed(round_number, DIAGNOSTICS_STREAM)
        history = self._reservoir.history()
        with stopwatch.measure("diagnostics"), seeded_context(seed):
            actions = action_diagnostics(strategy, history, strength, seed) if history else None
            kept = (episode.observations for episode in self.journal.kept(round_number))
            states = state_diagnostics(kept, self.demonstrations.stats or {}, seed)
        return RoundDiagnostics(actions, states, stopwatch.seconds["diagnostics"])
