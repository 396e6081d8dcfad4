"""The success filter: which episodes are worth learning from."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.replay.episode import Episode, EpisodeRecord


@dataclass(frozen=True)
class SuccessFilter:
    """Which episodes enter the replay; the same for every strategy.

    Attributes:
        min_reward: an episode passes if its largest reward reaches this; None: if the environment says
            `is_success` at its last step.
        min_length: shorter episodes are trivial, and so are those whose first step already passes.
        keep_failures: whether episodes that fail enter too, as in DAgger (arXiv:1011.0686), which has no filter.
    """

    min_reward: float | None
    min_length: int
    keep_failures: bool = False

    @classmethod
    def from_config(cls, config: CollectConfig) -> SuccessFilter:
        """The filter of `--policy.collect.min_reward`, `min_length` and `keep_failures`."""
        return cls(config.min_reward, config.min_length, config.keep_failures)

    def judge(self, episode: Episode) -> EpisodeRecord:
        """Pass or fail, keep or drop; an episode that the student finished alone teaches it nothing.

        Raises:
            ValueError: if success is asked of an environment that does not report it.
        """
        if self.min_reward is not None:
            passed = episode.max_reward >= self.min_reward
            at_start = bool(episode.rewards[0] >= self.min_reward)
        elif episode.successes is None:
            raise ValueError(
                "the environment reports no 'is_success' in its info, so successful episodes cannot be told from "
                "failed ones; filter by reward instead: --policy.collect.min_reward=..."
            )
        else:
            passed = bool(episode.successes[-1])
            at_start = bool(episode.successes[0])
        trivial = at_start or len(episode) < self.min_length
        return EpisodeRecord(
            number=episode.ticket.number,
            seed=episode.ticket.seed,
            scale=episode.ticket.scale,
            length=len(episode),
            max_reward=episode.max_reward,
            success=episode.success,
            passed=passed,
            trivial=trivial,
            kept=(passed or self.keep_failures) and not trivial and not episode.student_alone,
            j=episode.j,
            shift=episode.shift,
            student_steps=episode.student_steps,
            student_alone=episode.student_alone,
            retry=episode.ticket.retry,
        )
