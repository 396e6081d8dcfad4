"""One collection round: this process's share of the episodes, from tickets to finished datasets."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors
from lerobot.utils.random_utils import seeded_context
from tqdm import tqdm

from lerobot_agpd.collect.decider import Decider
from lerobot_agpd.collect.diagnostics import action_diagnostics, state_diagnostics
from lerobot_agpd.collect.report import summarise
from lerobot_agpd.collect.rollout import Rollouts
from lerobot_agpd.collect.seeds import failed_starts, noise_seed, round_tickets, share_of
from lerobot_agpd.collect.stopwatch import Stopwatch
from lerobot_agpd.collect.success import SuccessFilter
from lerobot_agpd.collect.witness import Witness
from lerobot_agpd.replay.episode import Episode, EpisodeRecord, Ticket
from lerobot_agpd.replay.store import ReplayStore, Spool
from lerobot_agpd.replay.writer import EpisodeWriter
from lerobot_agpd.run import barrier

logger = logging.getLogger(__name__)

DIAGNOSTICS = 3
"""Stream of the random numbers of a round's diagnostics; the teacher's noise is stream 1."""


class RoundRunner:
    """Collects rounds with whatever strategy it is given.

    Args:
        store: where rounds go.
        env_config: the environment.
        policy_config: the student's configuration, with the `collect` group.
        demonstrations: metadata of the demonstrations, whose features the datasets take over.
        seed: of the run.
        rank: of this process.
        n_ranks: number of processes.
    """

    def __init__(
        self,
        store: ReplayStore,
        env_config: EnvConfig,
        policy_config: Any,
        demonstrations: LeRobotDatasetMetadata,
        seed: int,
        rank: int,
        n_ranks: int,
    ):
        self.store = store
        self.env_config = env_config
        self.policy_config = policy_config
        self.config = policy_config.collect
        self.filter = SuccessFilter.from_config(self.config)
        self.writer = EpisodeWriter(demonstrations)
        self.seed, self.rank, self.n_ranks = seed, rank, n_ranks

    @property
    def identity(self) -> dict[str, Any]:
        """What makes a round this run's: every report of one says so."""
        return {
            "strategy": self.config.strategy,
            "environment": {"type": self.env_config.type, "task": self.env_config.task},
            "teacher": self.policy_config.teacher.path,
            "seed": self.seed,
        }

    def check_own(self, report: Mapping[str, Any]) -> None:
        """Refuse rounds that another run collected: they would silently be this one's.

        Raises:
            ValueError: naming what differs.
        """
        differing = [
            f"{name} {report[name]!r} instead of {mine!r}"
            for name, mine in self.identity.items()
            if report.get(name, mine) != mine  # older reports have no seed
        ]
        if differing:
            raise ValueError(
                f"{self.store.root} holds rounds of another run ({'; '.join(differing)}); name another "
                "--policy.replay.root, or resume that run (--resume=true)"
            )

    def noise(self, number: int) -> torch.Generator:
        """Source of this process's sampling noise in a round."""
        generator = torch.Generator(device=self.policy_config.device)
        return generator.manual_seed(noise_seed(self.seed, self.rank, number))

    def tickets(self, number: int, scale: float) -> list[Ticket]:
        """The episodes of this process's share of a round; the same whenever asked."""
        config = self.config
        earlier = [round_.report for round_ in self.store.rounds()[:number]] if config.retry_fraction else []
        n_retries = int(config.retry_fraction * share_of(config.episodes, self.rank, self.n_ranks))
        return round_tickets(
            config.episodes,
            self.seed,
            self.rank,
            self.n_ranks,
            number,
            scale,
            config.unguided_fraction,
            scale_spread=config.variation.scale_spread,
            max_student_share=config.rollin.max_fraction if config.strategy == "rollin" else 0.0,
            retries=failed_starts(earlier)[self.rank :: self.n_ranks][:n_retries],
        )

    def collect(
        self, number: int, scale: float, decider: Decider
    ) -> tuple[list[EpisodeRecord], dict[str, float]]:
        """Roll out what is missing of the round, write this process's dataset and wait for the others.

        Args:
            number: of the round.
            scale: guidance scale, or mixing weight.
            decider: the strategy, made for this round; its stopwatch takes the time.

        Returns:
            Records of all processes' episodes, and the seconds this one spent in teacher, student, environment
            and writing.
        """
        spool = self.store.spool(number, self.rank)
        tickets = self.tickets(number, scale)
        missing = [ticket for ticket in tickets if ticket.number not in spool.records]
        if missing:
            self._roll_out(number, missing, len(tickets), decider, spool)
        with decider.stopwatch.measure("writing"):
            self.store.write_share(
                number,
                self.rank,
                lambda root, episodes: self.writer.write(root, episodes, number, self.config.strategy),
            )
        barrier()
        return self.store.records(number, self.n_ranks), decider.stopwatch.seconds

    def _roll_out(
        self,
        number: int,
        tickets: Sequence[Ticket],
        n_total: int,
        decider: Decider,
        spool: Spool,
    ) -> None:
        n_envs = min(self.config.n_envs, len(tickets))
        tasks = make_env(self.env_config, n_envs=n_envs, use_async_envs=self.config.use_async_envs)
        environments = [envs for suite in tasks.values() for envs in suite.values()]
        processors = make_env_pre_post_processors(self.env_config, self.policy_config)
        progress = tqdm(
            total=n_total,
            initial=n_total - len(tickets),
            desc=f"Collecting round {number}",
            unit="episode",
            leave=False,
            disable=self.rank != 0,
        )
        try:
            for position, envs in enumerate(environments):
                rollouts = Rollouts(envs, processors, decider, self.config.rollin, self.writer.check)
                for episode in rollouts.run(tickets[position :: len(environments)]):
                    with decider.stopwatch.measure("writing"):
                        spool.add(episode, self.filter.judge(episode))
                    kept = sum(record.kept for record in spool.records.values())
                    progress.set_postfix_str(f"{kept} of {len(spool.records)} kept")
                    progress.update()
        finally:
            progress.close()
            close_envs(tasks)

    @torch.no_grad()
    def diagnose(self, number: int, scale: float, decider: Decider) -> dict[str, Any] | None:
        """What the strategy did to actions and states; called on one process, before `finish`.

        Actions are sampled again where this process has watched `decider` decide since it started the round;
        states are those of all processes' kept episodes.

        Returns:
            None if `--policy.collect.diagnostics.observations` is 0.
        """
        if not isinstance(decider, Witness):
            return None
        config, stopwatch = self.config.diagnostics, Stopwatch()
        seed = noise_seed(self.seed, self.rank, number, stream=DIAGNOSTICS)
        history = decider.history()
        with stopwatch.measure("diagnostics"), seeded_context(seed):
            actions = history and action_diagnostics(decider.decider, history, scale, config.samples, seed)
            stats = self.writer.demonstrations.stats
            states = state_diagnostics(self._kept(number), stats, config, seed)
        return {"actions": actions, "states": states, "seconds": stopwatch.seconds["diagnostics"]}

    def _kept(self, number: int) -> Iterator[Episode]:
        for rank in range(self.n_ranks):
            yield from self.store.spool(number, rank).kept()

    def report(
        self,
        number: int,
        scale: float,
        records: Sequence[EpisodeRecord],
        seconds: Mapping[str, float],
        diagnostics: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """The round's numbers."""
        return {
            "round": number,
            **self.identity,
            "scale": scale,
            "seconds": dict(seconds),
            "diagnostics": diagnostics,
            **summarise(records),
        }

    def finish(self, number: int, report: Mapping[str, Any]) -> None:
        """Make the round a finished one; called on one process."""
        self.store.finish(number, self.n_ranks, report)

    def merge(self) -> None:
        """Merge all rounds into one dataset and upload it if asked to; called on one process.

        A failure is logged: LeRobot has yet to write the last checkpoint, and the rounds are complete as they are.
        """
        try:
            merged = self.store.merge(self.config.repo_id)
            if merged is not None and self.config.push_to_hub:
                merged.push_to_hub()
        except Exception:
            upload = f" --repo_id={self.config.repo_id} --push_to_hub=true" if self.config.push_to_hub else ""
            logger.exception(
                "the collected episodes could not be merged or uploaded; the rounds are complete in %s. Once the "
                "cause is gone, run lerobot-agpd-merge --root=%s%s",
                self.store.root,
                self.store.root,
                upload,
            )
