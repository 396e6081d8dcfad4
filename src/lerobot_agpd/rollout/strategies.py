"""Collection strategies: what is executed while episodes are collected.

teacher  the teacher alone                                  TeacherStrategy          PD
mixing   teacher and student share the actions              MixingStrategy           DAgger, Eq. 6-7
rollin   the student begins, another strategy finishes      RollInStrategy           not in the paper
guided   the teacher, guided toward the student             agpd.GuidedStrategy      AGPD, Eq. 19-20
nearest  the teacher's sample nearest to the student        NearestStrategy          not in the paper
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from lerobot_agpd.config import MixingConfig
from lerobot_agpd.guidance.teacher import History
from lerobot_agpd.guidance.teacher_student import TeacherStudent
from lerobot_agpd.stopwatch import Stopwatch


@dataclass(frozen=True)
class ChunkBatch:
    """Chunks to execute.

    Attributes:
        actions: (B, n, A) in the environment's units.
        discrepancy: (B,) action J between what is executed and the student's chunk; NaN without a student.
        guidance_shift: (B,) mean shift of the guided denoising steps in sigmas; NaN where unguided.
        recorded: (B, n, A) what the episode records; None: what is executed.
    """

    actions: Tensor
    discrepancy: Tensor
    guidance_shift: Tensor
    recorded: Tensor | None = None


class Strategy(ABC):
    """A collection strategy, made of a teacher, a student and a source of noise.

    Args:
        pair: teacher and student.
        generator: of the sampling noise.
    """

    def __init__(self, pair: TeacherStudent, generator: torch.Generator):
        self.pair = pair
        self.generator = generator

    @property
    def n_obs_steps(self) -> int:
        """Length of the observation history it needs."""
        return self.pair.n_obs_steps

    @property
    def stopwatch(self) -> Stopwatch:
        """Takes the time of everything that a rollout with this strategy does."""
        return self.pair.stopwatch

    @abstractmethod
    def act(self, history: History, strength: Tensor, student_acts: Tensor | None = None) -> ChunkBatch:
        """Chunks to execute.

        Args:
            history: raw observations (B, n_obs_steps, ...), and under "task" B instructions.
            strength: (B,) pulls, guidance scales or mixing weights; at 0 the teacher acts as it does alone.
            student_acts: (B,) bool, True where the student still acts (rollin only); None: nowhere.
        """

    def reseeded(self, generator: torch.Generator) -> Self:
        """The same strategy with another source of noise and a stopwatch of its own."""
        clone = copy(self)
        clone.generator = generator
        clone.pair = replace(self.pair, stopwatch=Stopwatch())
        return clone


class TeacherStrategy(Strategy):
    """The teacher acts alone (policy distillation, PD); the student proposes nothing."""

    def act(self, history: History, strength: Tensor, student_acts: Tensor | None = None) -> ChunkBatch:
        """The teacher's chunks, whatever the strength."""
        actions = self.pair.teacher_actions(history, self.generator)
        return ChunkBatch(actions, discrepancy=unknown(actions), guidance_shift=unknown(actions))


class MixingStrategy(Strategy):
    """Teacher and student share the actions (DAgger, arXiv:1011.0686), with the student's weight lambda.

    - `interpolate`: lambda A_A + (1 - lambda) A_E, in raw actions (Eq. 6).
    - `switch`: A_A with probability lambda, else A_E, drawn at every decision (Eq. 7).

    Eq. 7 is printed as the distribution of Eq. 6; they are different strategies. DAgger's beta is the expert's
    weight: lambda = 1 - beta.
    """

    def __init__(self, pair: TeacherStudent, generator: torch.Generator, config: MixingConfig):
        super().__init__(pair, generator)
        self.config = config

    def act(self, history: History, strength: Tensor, student_acts: Tensor | None = None) -> ChunkBatch:
        """Mixed chunks; `strength` is lambda, at 0 they are the teacher's bit for bit, at 1 the student's."""
        of_teacher = self.pair.teacher_actions(history, self.generator)  # (B, n, A) raw
        of_student = self.pair.student_actions(history).to(of_teacher)
        mixing_weight = self._coins(strength) if self.config.form == "switch" else strength
        mixed = torch.lerp(of_teacher, of_student, mixing_weight.to(of_teacher)[:, None, None])
        target = self.pair.teacher.normalize(of_student)
        return ChunkBatch(
            mixed,
            discrepancy=self.pair.executed_discrepancy(mixed, target),
            guidance_shift=unknown(mixed),
            recorded=of_teacher if self.config.record_teacher else None,
        )

    def _coins(self, probability: Tensor) -> Tensor:
        """1 with the given probabilities, else 0, (B,)."""
        device = self.generator.device
        drawn = torch.rand(len(probability), generator=self.generator, device=device)  # in [0, 1)
        return (drawn < probability.to(device)).to(probability)


class NearestStrategy(Strategy):
    """Sample several chunks of the teacher and execute the one with the smallest J.

    Not in the paper: guidance without gradients, for any stochastic teacher, also one that cannot be guided. It costs
    as many samples as `strength` says; with many independent choices per chunk that number must grow, which guidance's
    cost does not.
    """

    def act(self, history: History, strength: Tensor, student_acts: Tensor | None = None) -> ChunkBatch:
        """The nearest of `strength` samples; rows at 0 are the teacher's own bit for bit, as is every first sample."""
        chunk_hat = self.pair.propose(history)  # (B, S, A), student-normalized
        actions = self.pair.teacher_actions(history, self.generator)  # (B, n, A) raw
        chosen, n_more = strength > 0, int(strength.max()) - 1
        if n_more > 0:
            asked = select(history, chosen)
            target = chunk_hat[chosen.to(chunk_hat.device)]
            more = self.pair.teacher_actions(repeat(asked, n_more), self.generator)
            candidates = torch.cat([actions[chosen][:, None], more.unflatten(0, (-1, n_more))], dim=1)
            nearest = self._discrepancies(asked, target, candidates).argmin(dim=1)  # of (B', N, n, A)
            actions[chosen] = candidates[torch.arange(len(nearest)), nearest.to(candidates.device)]
        target = self.pair.student_in_teacher_space(chunk_hat)
        return ChunkBatch(
            actions,
            discrepancy=self.pair.executed_discrepancy(actions, target),
            guidance_shift=unknown(actions),
        )

    def _discrepancies(self, history: History, chunk_hat: Tensor, candidates: Tensor) -> Tensor:
        """The guiding J, (B, N), of raw executed steps (B, N, n, A)."""
        n_samples = candidates.shape[1]
        history, chunk_hat = repeat(history, n_samples), chunk_hat.repeat_interleave(n_samples, dim=0)
        action_j = self.pair.action_discrepancy(chunk_hat)
        discrepancy = self.pair.guiding_discrepancy(history, chunk_hat, action_j)
        executed = self.pair.teacher.normalize(candidates.flatten(0, 1))  # (B * N, n, A)
        past = executed.new_zeros(len(executed), self.pair.teacher.start, executed.shape[2])
        return discrepancy(torch.cat([past, executed], dim=1)).unflatten(0, (-1, n_samples))


class RollInStrategy(Strategy):
    """The student acts first, then another strategy finishes the episode.

    Not in the paper, whose student never acts during collection. The teacher shows what to do in states that the
    student gets itself into, which is DAgger's point, without executing the student's actions beside the teacher's.

    Args:
        finisher: acts where the student no longer does.
    """

    def __init__(self, finisher: Strategy):
        super().__init__(finisher.pair, finisher.generator)
        self.finisher = finisher

    def reseeded(self, generator: torch.Generator) -> Self:
        """The same strategy, its finisher too, with another source of noise."""
        clone = super().reseeded(generator)
        clone.finisher = self.finisher.reseeded(generator)
        clone.pair = clone.finisher.pair
        return clone

    def act(self, history: History, strength: Tensor, student_acts: Tensor | None = None) -> ChunkBatch:
        """The student's chunks where `student_acts`, the finisher's elsewhere."""
        if student_acts is None or not student_acts.any():
            return self.finisher.act(history, strength)
        of_student = self.pair.student_actions(select(history, student_acts)).cpu()
        actions = of_student.new_empty(len(student_acts), *of_student.shape[1:])
        actions[student_acts] = of_student
        discrepancy, guidance_shift = unknown(actions), unknown(actions)
        if not student_acts.all():
            rest = ~student_acts
            finishing = self.finisher.act(select(history, rest), strength[rest])
            actions[rest] = finishing.actions.to(actions)
            discrepancy[rest] = finishing.discrepancy.to(discrepancy)
            guidance_shift[rest] = finishing.guidance_shift.to(guidance_shift)
        return ChunkBatch(actions, discrepancy, guidance_shift)


def select(history: History, chosen: Tensor) -> dict[str, Any]:
    """The rows of a history that a mask (B,) chooses."""
    return {
        key: value[chosen.to(value.device)] if isinstance(value, Tensor) else _chosen(value, chosen)
        for key, value in history.items()
    }


def repeat(history: History, times: int) -> dict[str, Any]:
    """Every row of a history several times in a row."""
    return {
        key: value.repeat_interleave(times, dim=0)
        if isinstance(value, Tensor)
        else [entry for entry in value for _ in range(times)]
        for key, value in history.items()
    }


def _chosen(values: Sequence[str], chosen: Tensor) -> list[str]:
    return [value for value, keep in zip(values, chosen.tolist(), strict=True) if keep]


def unknown(chunks: Tensor) -> Tensor:
    """NaN for every row of chunks (B, ...)."""
    return torch.full((len(chunks),), float("nan"))
