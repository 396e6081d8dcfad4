"""What the measurements of a teacher mean: whether guidance can help, and the flags to type."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from scipy.stats import binomtest

from lerobot_agpd.config import GuidanceConfig

PullName = Literal["teacher", "guided", "nearest"]
Finding = Literal["deterministic", "one way", "several ways, median a way", "several ways"]

GUIDANCE_STRENGTHS = (0.3, 0.6, 1.0)
"""Pulls that are tried, weakest first, as far as the teacher's denoising steps can follow them."""

MAX_PULL = GuidanceConfig().max_pull

NEAREST_SAMPLES = (4, 16)
"""Numbers of samples that `nearest` is tried with."""

SAME = 1e-5
"""Chunks are the same if they differ by less, as a root mean square in normalized actions: rounding does."""

FALSE_ALARMS = 0.02
"""Several ways are found in a group of states if more than this fraction has them: that much is chance (docs/probe.md)."""

COPES = 0.9
"""A student copes by itself if the median is a way at this fraction of the states with several ways."""

CHOOSES = 0.9
"""A strength is enough if it chooses the target's way this often."""

LOST = 0.1
"""A strength is too much if this many more of its chunks are no way than of the teacher's own."""

AS_GOOD = 0.05
"""Fewer steps are as good as all of them if the success rate is at most this much lower."""


@dataclass(frozen=True)
class Pull:
    """What a strategy does to the teacher's chunks.

    Attributes:
        strategy: `teacher` (alone), `guided` or `nearest`.
        strength: pull, or number of samples.
        moved: fraction of the teacher's root-mean-square distance from the target by which it is nearer.
        chooses: at states with several ways, fraction of its chunks on the target's; None without such states.
        off: at the same states, fraction of its chunks that are no way.
    """

    strategy: PullName
    strength: float
    moved: float
    chooses: float | None
    off: float | None


@dataclass(frozen=True)
class StateCount:
    """How many of a group of states have several ways."""

    several: int
    total: int

    @property
    def fraction(self) -> float:
        """Of the states, those with several ways."""
        return self.several / self.total if self.total else 0.0

    @property
    def is_found(self) -> bool:
        """Whether they are more than chance alone would find (one-sided exact binomial test at 1 %)."""
        if self.several == 0:
            return False
        return bool(binomtest(self.several, self.total, FALSE_ALARMS, alternative="greater").pvalue < 0.01)


@dataclass(frozen=True)
class Evidence:
    """What a verdict follows from.

    Attributes:
        spread: standard deviation of the teacher's samples.
        can_be_guided: whether the teacher can be guided.
        starts: first states of episodes.
        states: states anywhere in episodes.
        median_is_way: of the states with several ways, fraction at which the median of the samples is one.
        mean_is_way: the same of their mean.
        pulls: strategies, in the order of preference.
    """

    spread: float
    can_be_guided: bool
    starts: StateCount
    states: StateCount
    median_is_way: float | None
    mean_is_way: float | None
    pulls: Sequence[Pull]


@dataclass(frozen=True)
class Verdict:
    """The answer.

    Attributes:
        finding: in short.
        reasons: in words, one sentence or two each.
        flags: of `lerobot-train`.
    """

    finding: Finding
    reasons: Sequence[str]
    flags: str


def conclude(evidence: Evidence) -> Verdict:
    """Whether guidance can help with this teacher, why, and the flags to type."""
    alone = "--policy.collect.strategy=teacher"
    if evidence.spread < SAME:
        reason = (
            "The teacher always answers with the same chunk. It has one way per state: guidance has nothing to choose "
            "from, and the teacher collects alone (PD)."
        )
        return Verdict("deterministic", [reason], alone)
    if not (evidence.starts.is_found or evidence.states.is_found):
        reason = (
            f"One way: the samples of a state do not fall into groups ({_where(evidence)}). PD is enough; guidance "
            "will not help."
        )
        return Verdict("one way", [reason], alone)
    assert evidence.median_is_way is not None and evidence.mean_is_way is not None
    reasons = [f"Several ways: {_where(evidence)}."]
    copes = evidence.median_is_way >= COPES
    if copes:
        reasons.append(
            f"The median of the samples is a way at {evidence.median_is_way:.0%} of them, so a student trained with L1 "
            "(ACT) takes the most frequent way and PD (--policy.collect.strategy=teacher) may do."
        )
        reasons.append(
            f"The mean is a way at {evidence.mean_is_way:.0%}: "
            + (
                "a student trained with L2 copes, too."
                if evidence.mean_is_way >= COPES
                else "with L2, guide."
            )
        )
    else:
        reasons.append(
            f"The median of the samples is a way at only {evidence.median_is_way:.0%} of them, the mean at "
            f"{evidence.mean_is_way:.0%}: a deterministic student that learns from the teacher alone ends up between "
            "the ways. Guide."
        )
    advice, flags = recommend(evidence)
    return Verdict("several ways, median a way" if copes else "several ways", [*reasons, advice], flags)


def recommend(evidence: Evidence) -> tuple[str, str]:
    """The weakest pull that chooses the target's way and stays on the ways: a sentence, and flags."""
    alone = next(pull for pull in evidence.pulls if pull.strategy == "teacher")
    usable = [pull for pull in evidence.pulls if pull.strategy != "teacher"]
    enough = [pull for pull in usable if (pull.chooses or 0) >= CHOOSES and _stays(pull, alone)]
    staying = [pull for pull in usable if _stays(pull, alone)]
    best = enough[0] if enough else max(staying or usable, key=lambda pull: pull.chooses or 0)
    how = f"chooses the target's way in {best.chooses:.0%} of the chunks, the teacher alone in {alone.chooses:.0%}"
    sentence = f"{_name(best)} {how}."
    if not evidence.can_be_guided:
        sentence = f"This teacher cannot be guided. {sentence}"
    if not enough:
        sentence += f" None of those tried reaches {CHOOSES:.0%} without leaving the ways."
    # An adapted pull may rise no higher than what was found to keep to the ways.
    limit = max((pull.strength for pull in staying if pull.strategy == "guided"), default=best.strength)
    return sentence, pull_flags(best, limit)


def pull_flags(pull: Pull, limit: float) -> str:
    """The flags of `lerobot-train` that begin with a strength, which may grow up to a limit."""
    if pull.strategy == "nearest":
        return f"--policy.collect.strategy=nearest --policy.collect.nearest_samples={pull.strength:.0f}"
    most = "" if limit == MAX_PULL else f" --policy.guidance.max_pull={limit:g}"
    return f"--policy.collect.strategy=guided --policy.guidance.pull={pull.strength:g}{most}"


def fewer_steps(success: Sequence[tuple[int, float, float]]) -> str:
    """Whether the teacher with fewer denoising steps would do.

    Args:
        success: steps, success rate and milliseconds per chunk, by steps; the last row has all steps.
    """
    all_steps, rate, milliseconds = success[-1]
    steps, fewer_rate, fewer_milliseconds = next(row for row in success if row[1] >= rate - AS_GOOD)
    if steps == all_steps:
        return (
            f"Fewer denoising steps do not replace a student: the teacher succeeds in {rate:.0%} with {steps} steps "
            f"({milliseconds:.1f} ms per chunk), in less with fewer."
        )
    return (
        f"The teacher succeeds in {fewer_rate:.0%} with {steps} denoising step{'s' * (steps != 1)} "
        f"({fewer_milliseconds:.1f} ms per chunk), in {rate:.0%} with {all_steps} ({milliseconds:.1f} ms): it may be fast "
        "enough without a student."
    )


def _where(evidence: Evidence) -> str:
    groups = (("first states of episodes", evidence.starts), ("states anywhere", evidence.states))
    return ", ".join(
        f"{count.several} of {count.total} {name} ({count.fraction:.0%}) have several"
        for name, count in groups
    )


def _stays(pull: Pull, alone: Pull) -> bool:
    return (pull.off or 0) <= (alone.off or 0) + LOST


def _name(pull: Pull) -> str:
    if pull.strategy == "nearest":
        return f"The nearest of {pull.strength:.0f} samples"
    return f"Guidance with pull {pull.strength:g}"
