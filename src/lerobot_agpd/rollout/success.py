"""The success filter: which episodes are worth learning from; the same for every strategy."""

from __future__ import annotations

from lerobot_agpd.config import CollectConfig
from lerobot_agpd.replay.episode import Episode, EpisodeRecord
from lerobot_agpd.replay.gate import first_not_finite

MIN_LENGTH = 2
"""Episodes with fewer steps count as solved at the start: they teach nothing."""


def classify(episode: Episode, config: CollectConfig) -> EpisodeRecord:
    """Decide whether an episode succeeded and whether to keep it.

    An episode succeeds if its largest reward reaches `min_reward`, or, without that, if the environment says
    `is_success` at its last step. One that succeeds at its first step, or that the student finished alone, is dropped.
    With `keep_failures` failures are kept too, as in DAgger (arXiv:1011.0686), which has no filter. An episode that
    holds a number that is not finite, or that the environment did not finish, is neither a success nor kept.

    Raises:
        ValueError: if success is required of an environment that does not report it.
    """
    if episode.problem is not None:
        success = at_start = False
    elif config.min_reward is not None:
        success = episode.max_reward >= config.min_reward
        at_start = bool(episode.rewards[0] >= config.min_reward)
    elif episode.successes is None:
        raise ValueError(
            "the environment reports no 'is_success' in its info, so successful episodes cannot be told from "
            "failed ones; filter by reward instead: --policy.collect.min_reward=..."
        )
    else:
        success = bool(episode.successes[-1])
        at_start = bool(episode.successes[0])
    solved_at_start = episode.problem is None and (at_start or len(episode) < MIN_LENGTH)
    not_finite = None if episode.problem else first_not_finite(episode.columns)
    invalid = episode.problem or (not_finite and f"{not_finite} is not finite")
    success = success and invalid is None
    worth_keeping = (success or config.keep_failures) and invalid is None
    return EpisodeRecord(
        number=episode.spec.number,
        seed=episode.spec.seed,
        strength=episode.spec.strength,
        length=len(episode),
        max_reward=episode.max_reward,
        is_success=episode.is_success,
        success=success,
        solved_at_start=solved_at_start,
        kept=worth_keeping and not solved_at_start and not episode.student_alone,
        discrepancy=episode.discrepancy,
        guidance_shift=episode.guidance_shift,
        student_steps=episode.student_steps,
        student_alone=episode.student_alone,
        retry=episode.spec.retry,
        invalid=invalid,
    )
