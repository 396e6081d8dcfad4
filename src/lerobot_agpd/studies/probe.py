"""Probe a teacher: its samples at recorded states, how far they can be pulled, and what a chunk costs.

states      starts of episodes, and frames anywhere in them      probe_states.py
samples     K chunks of the teacher at each                    probe_ways.py counts the ways among them
pull        guidance and `nearest` toward a target chunk       the student's, or one more sample of the teacher
cost        milliseconds and success by denoising steps
conclude    what it means, and the flags to type               probe_verdict.py
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.agpd import GuidedStrategy
from lerobot_agpd.config import GuidanceConfig
from lerobot_agpd.guidance.pull import largest_pull
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.guidance.teacher_student import TeacherStudent
from lerobot_agpd.replay.episode import Array
from lerobot_agpd.rollout.diagnostics import sample_spread
from lerobot_agpd.rollout.strategies import NearestStrategy, Strategy, TeacherStrategy, repeat
from lerobot_agpd.stopwatch import call_times
from lerobot_agpd.student import StudentSampler, executed_steps
from lerobot_agpd.studies.probe_states import RecordedStates
from lerobot_agpd.studies.probe_verdict import (
    GUIDANCE_STRENGTHS,
    NEAREST_SAMPLES,
    SAME,
    Evidence,
    Pull,
    PullName,
    StateCount,
)
from lerobot_agpd.studies.probe_ways import Ways, find_ways

ROWS, ROWS_WITH_CAMERAS = 128, 16
"""Chunks sampled at a time."""

PULLED = 4
"""Chunks of every strategy at each state."""

TIMED = 20
"""Chunks whose time is taken."""


@dataclass(frozen=True)
class TeacherProbe:
    """Ask a teacher at recorded states.

    Attributes:
        teacher: the teacher.
        states: where.
        n_samples: samples K per state.
        seed: of the noise.
        student: whose chunk is the target of pulls; None: one more sample of the teacher.
    """

    teacher: Teacher
    states: RecordedStates
    n_samples: int
    seed: int
    student: StudentSampler | None = None

    @property
    def n_steps(self) -> int:
        """Executed steps n of a chunk."""
        if self.student is None:
            return self.teacher.n_action_steps
        return executed_steps(self.student.config, self.teacher)

    # ---- samples ----

    @cached_property
    def _sampled(self) -> Tensor:
        """K + 1 chunks of every state, (S, K + 1, n, A) in the teacher's normalized space."""
        noise = self._noise(0)
        return torch.stack([self._samples(state, noise) for state in range(len(self.states))])

    def _samples(self, state: int, noise: torch.Generator) -> Tensor:
        """Chunks (K + 1, n, A) at one state."""
        history, parts = self.states.history(torch.tensor([state])), []
        for rows in torch.arange(self.n_samples + 1).split(self._rows):
            raw = self.teacher.sample(repeat(history, len(rows)), generator=noise)[:, : self.n_steps]
            parts.append(self.teacher.normalize(raw).cpu())
        return torch.cat(parts)

    @property
    def samples(self) -> Tensor:
        """(S, K, n, A) in the teacher's normalized space."""
        return self._sampled[:, :-1]

    @cached_property
    def targets(self) -> Tensor:
        """Where chunks are pulled, (S, n, A) in the teacher's normalized space.

        The student's chunk; without a student one more sample of the teacher, as of a student that has settled for
        one of its ways.
        """
        if self.student is None:
            return self._sampled[:, -1]
        pair = self.student.pair_with(self.teacher)
        with torch.no_grad():
            parts = [
                pair.student_in_teacher_space(pair.propose(self.states.history(part))).cpu()
                for part in torch.arange(len(self.states)).split(self._rows)
            ]
        return torch.cat(parts)

    @cached_property
    def ways(self) -> list[Ways]:
        """The ways of every state."""
        return [find_ways(chunks.flatten(1).numpy()) for chunks in self.samples]

    # ---- pulls ----

    def pulls(self) -> list[Pull]:
        """The teacher alone, guided if it can be, and the nearest of several samples."""
        settings: list[tuple[PullName, float]] = [("teacher", 0.0)]
        settings += [("guided", strength) for strength in self._guidance_strengths]
        settings += [("nearest", float(number)) for number in NEAREST_SAMPLES]
        chunks = {setting: self._pulled(*setting) for setting in settings}
        alone = _rms(chunks[settings[0]] - self.targets[:, None])
        return [
            Pull(
                name,
                strength,
                moved=1 - _rms(pulled - self.targets[:, None]) / alone if alone > SAME else 0.0,
                chooses=self._average(pulled, self._chooses),
                off=self._average(pulled, self._is_off),
            )
            for (name, strength), pulled in chunks.items()
        ]

    @property
    def _guidance_strengths(self) -> list[float]:
        """Pulls that the teacher's denoising steps can follow; none if these are of no known form."""
        if self.teacher.sampler is None:
            return []
        largest = largest_pull(self.teacher.sampler, self._guidance.at)
        return [strength for strength in GUIDANCE_STRENGTHS if strength <= largest]

    @property
    def _guidance(self) -> GuidanceConfig:
        return GuidanceConfig(
            at=self.student.config.guidance.at if self.student else self.teacher.guidance_points[0]
        )

    def _pulled(self, name: PullName, strength: float) -> Tensor:
        """Chunks (S, PULLED, n, A) of a strategy in the teacher's normalized space."""
        noise, parts = self._noise(1), []
        for part in torch.arange(len(self.states)).split(max(1, self._rows // PULLED)):
            strategy = self._strategy(name, repeat_rows(self.targets[part], PULLED), noise)
            strengths = torch.full((len(part) * PULLED,), strength)
            raw = strategy.act(repeat(self.states.history(part), PULLED), strengths).actions
            parts.append(self.teacher.normalize(raw).cpu().unflatten(0, (-1, PULLED)))
        return torch.cat(parts)

    def _strategy(self, name: PullName, targets: Tensor, noise: torch.Generator) -> Strategy:
        """A strategy beside a student that always proposes the targets (B, n, A)."""
        proposed = targets.to(noise.device)
        pair = TeacherStudent(
            teacher=self.teacher,
            student=lambda history: proposed,
            n_steps=self.n_steps,
            normalize=self.teacher.normalize,
            unnormalize=self.teacher.unnormalize,
        )
        if name == "guided":
            return GuidedStrategy(pair, noise, self._guidance)
        return NearestStrategy(pair, noise) if name == "nearest" else TeacherStrategy(pair, noise)

    def _average(self, pulled: Tensor, measure: Callable[[Ways, Array, Array], Array]) -> float | None:
        """A measure's mean over the chunks at states with several ways."""
        values = [
            measure(ways, chunks.flatten(1).numpy(), target.flatten()[None].numpy())
            for ways, chunks, target in zip(self.ways, pulled, self.targets, strict=True)
            if len(ways) > 1
        ]
        return float(np.mean(values)) if values else None

    @staticmethod
    def _chooses(ways: Ways, chunks: Array, target: Array) -> Array:
        return ways.nearest(chunks) == ways.nearest(target)

    @staticmethod
    def _is_off(ways: Ways, chunks: Array, target: Array) -> Array:
        return ways.remoteness(chunks) > 1

    # ---- cost ----

    def step_counts(self) -> list[int]:
        """Numbers of denoising steps to try: 1, 2, 4, ... and the teacher's own; empty without steps."""
        steps = self.teacher.n_denoising_steps
        return [] if steps is None else sorted({*(2**k for k in range(steps.bit_length())), steps})

    def latency(self) -> list[tuple[int | None, float]]:
        """Denoising steps and the median milliseconds of a chunk, its processors included; None: the only way."""
        history, own = self.states.history(torch.tensor([0])), self.teacher.n_denoising_steps
        counts: Sequence[int | None] = self.step_counts() or [None]
        rows = []
        try:
            for steps in counts:
                self.teacher.set_sampler(steps, None)
                times = call_times(partial(self.teacher.sample, history, generator=self._noise(2)), TIMED)
                rows.append((steps, float(np.median(times))))
        finally:
            self.teacher.set_sampler(own, None)
        return rows

    # ---- results ----

    def evidence(self, pulls: Sequence[Pull]) -> Evidence:
        """What the verdict follows from."""
        several = [state for state, ways in enumerate(self.ways) if len(ways) > 1]
        counts = []
        for group in (self.states.is_start, ~self.states.is_start):
            members = set(group.nonzero()[:, 0].tolist())
            counts.append(StateCount(len(members & set(several)), len(members)))
        remote = np.array([self.average_remoteness(state) for state in several]).reshape(-1, 2)
        median, mean = (remote <= 1).mean(axis=0) if several else (None, None)
        return Evidence(
            spread=sample_spread(self.samples.transpose(0, 1)),
            can_be_guided=self.teacher.can_be_guided,
            starts=counts[0],
            states=counts[1],
            median_is_way=None if median is None else float(median),
            mean_is_way=None if mean is None else float(mean),
            pulls=pulls,
        )

    def average_remoteness(self, state: int) -> tuple[float, float]:
        """How far the coordinate-wise median and the mean of a state's samples are from a way, in its radii."""
        chunks = self.samples[state].flatten(1).numpy()
        averages = np.stack([np.median(chunks, axis=0), chunks.mean(axis=0)])
        median, mean = self.ways[state].remoteness(averages)
        return float(median), float(mean)

    def rows(self) -> list[dict[str, Any]]:
        """Every state for the JSON."""
        rows = []
        for state, (where, ways) in enumerate(zip(self.states.whereabouts(), self.ways, strict=True)):
            median, mean = self.average_remoteness(state)
            rows.append(
                {
                    **where,
                    "is_start": bool(self.states.is_start[state]),
                    "spread": sample_spread(self.samples[state]),
                    "n_ways": len(ways),
                    "weights": ways.weights.tolist(),
                    "radii": ways.radii.tolist(),
                    "distances": ways.distances.tolist(),
                    "median_remoteness": median,
                    "mean_remoteness": mean,
                }
            )
        return rows

    # ---- details ----

    @property
    def _rows(self) -> int:
        return ROWS_WITH_CAMERAS if self.states.has_cameras else ROWS

    def _noise(self, stream: int) -> torch.Generator:
        device = self.teacher.policy.config.device or "cpu"
        return torch.Generator(device=device).manual_seed(self.seed + stream)


def repeat_rows(chunks: Tensor, times: int) -> Tensor:
    """Every row several times in a row, as `strategies.repeat` does with histories."""
    return chunks.repeat_interleave(times, dim=0)


def _rms(gap: Tensor) -> float:
    return float(gap.square().mean().sqrt())
