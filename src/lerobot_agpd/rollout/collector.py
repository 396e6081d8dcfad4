"""Collects a round: this process's part of the episodes, in environments side by side."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.envs import EnvConfig, make_env_pre_post_processors
from lerobot.utils.random_utils import seeded_context
from tqdm import tqdm

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.replay.episode import Array, Episode, EpisodeRecord, EpisodeSpec
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.rollout.diagnostics import (
    ROUND_OBSERVATIONS,
    ROUND_SAMPLES,
    ObservationReservoir,
    RoundDiagnostics,
    action_diagnostics,
    state_diagnostics,
)
from lerobot_agpd.rollout.kept_environments import KeptEnvironments, slots
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

MAX_STEPS = 10_000
"""Steps after which an episode is cut off where the environment does not say when it ends one."""


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
        self._environments = KeptEnvironments(env_config, config.collect.use_async_envs)

    def noise(self, round_number: int) -> torch.Generator:
        """Source of this process's sampling noise in a round."""
        generator = torch.Generator(device=self.config.device or "cpu")
        return generator.manual_seed(self.stream_seed(round_number, TEACHER_NOISE_STREAM))

    def stream_seed(self, round_number: int, stream: int) -> int:
        """Seed of one of this process's streams of random numbers in a round."""
        return stream_seed(self.seed, self.rank, round_number, stream)

    def specs(self, round_number: int, strength: float) -> list[EpisodeSpec]:
        """The episodes of a round, of all processes; the same at every call."""
        collect = self.config.collect
        n_retries = int(collect.retry_fraction * collect.episodes)
        earlier: list[EpisodeRecord] = []
        if n_retries:
            earlier = [record for number in range(round_number) for record in self.journal.records(number)]
        return episode_specs(
            collect.episodes,
            self.seed,
            round_number,
            strength,
            collect.teacher_only_fraction,
            student_begins=collect.strategy == "rollin",
            retries=failed_starts(earlier)[:n_retries],
        )

    def roll_out(
        self, round_number: int, strength: float, strategy: Strategy, done: Collection[int]
    ) -> Iterator[Episode]:
        """Yield this process's part of the round's missing episodes as they finish.

        Args:
            round_number: of the round.
            strength: pull, guidance scale or mixing weight.
            strategy: made for this round; its stopwatch takes the time.
            done: numbers of the episodes that an interrupted round has already collected, on any number of processes;
                the same on every process.
        """
        self._reservoir = None
        if self.config.collect.diagnostics:
            seed = self.stream_seed(round_number, TEACHER_NOISE_STREAM)
            self._reservoir = ObservationReservoir(seed, ROUND_OBSERVATIONS)
        missing = rank_part(self.specs(round_number, strength), done, self.rank, self.n_ranks)
        if not missing:
            return
        progress = tqdm(
            total=len(missing),
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
        """Roll out the specs; where environments get stuck, the episodes beside theirs begin anew in new ones.

        Raises:
            TimeoutError: if environments get stuck without an episode of theirs.
        """
        while specs:
            ended, problem = set(), None
            for episode in self._until_stuck(specs, strategy, on_decision):
                ended.add(episode.spec.number)
                problem = episode.problem or problem
                yield episode
            specs = [spec for spec in specs if spec.number not in ended]
            if specs and not ended:
                raise TimeoutError(
                    f"the environment '{self.env_config.type}' (--env.*) does not answer in "
                    f"{self.config.collect.step_timeout:g} s (--policy.collect.step_timeout), or its worker processes end"
                )
            if problem:
                logger.warning(
                    "%s: its episode is dropped; the %d that are left go on in new environments",
                    problem,
                    len(specs),
                )

    def _until_stuck(
        self,
        specs: list[EpisodeSpec],
        strategy: Strategy,
        on_decision: Callable[[Decision], None] | None,
    ) -> Iterator[Episode]:
        """Roll out the specs, up to the first environments that get stuck: the last episodes then are theirs."""
        collect, kept = self.config.collect, self._environments
        environments = kept.of_size(slots(len(specs), collect.n_envs))
        processors = make_env_pre_post_processors(self.env_config, self.config)
        max_steps = collect.max_episode_steps or self._own_limit()
        completed = False
        try:
            for position, envs in enumerate(environments):
                rollouts = Rollouts(
                    envs, processors, strategy, on_decision, self.check, max_steps, collect.step_timeout
                )
                yield from rollouts.run(spec for spec in specs if spec.number % len(environments) == position)
                if rollouts.problem is not None:
                    return
            completed = True
        finally:
            if not completed:
                kept.end()

    def _own_limit(self) -> int:
        """Steps after which an episode is cut off where no flag says it: one more than the environment's own limit.

        So an environment that keeps its limit ends every episode itself.
        """
        limit = self._environments.step_limit
        return MAX_STEPS if limit is None else limit + 1

    def close(self) -> None:
        """Close the environments, after the last round."""
        self._environments.close()

    def require_valid_episodes(self, round_number: int) -> None:
        """Warn of a round's invalid episodes, of all processes, which have been dropped.

        Raises:
            RuntimeError: if most of the round's episodes are invalid.
        """
        records = self.journal.records(round_number)
        invalid = [record for record in records if record.invalid]
        if not invalid:
            return
        facts = (
            f"round {round_number}: {len(invalid)} of {len(records)} episodes are dropped (first: {invalid[0].invalid}, "
            f"environment seed {invalid[0].seed}), because of the environment '{self.env_config.type}' (--env.*)"
        )
        if 2 * len(invalid) > len(records):
            raise RuntimeError(
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
            actions = (
                action_diagnostics(strategy, history, strength, seed, ROUND_SAMPLES) if history else None
            )
            kept = (episode.observations for episode in self.journal.kept(round_number))
            states = state_diagnostics(kept, self.demonstrations.stats or {}, seed)
        n_sampled = actions["teacher_samples"] if actions else 0
        return RoundDiagnostics(actions, states, stopwatch.seconds["diagnostics"], int(n_sampled))
