"""An episode while it runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.replay.episode import Array, Episode, EpisodeSpec
from lerobot_agpd.rollout.strategies import ChunkBatch


class RunningEpisode:
    """What one sub-environment's episode has gathered so far.

    Args:
        spec: the episode's.
        n_obs_steps: length of the observation history.
        student_steps: steps after which the student hands over to the teacher.

    Attributes:
        history: the last observations, oldest first.
        queue: steps decided and not yet executed: the action to execute and the one to record, (A,) each.
    """

    def __init__(self, spec: EpisodeSpec, n_obs_steps: int, student_steps: int = 0):
        self.spec = spec
        self.history: deque[dict[str, Tensor]] = deque(maxlen=n_obs_steps)
        self.queue: deque[tuple[Tensor, Tensor]] = deque()
        self._student_steps = student_steps
        self._takeover: int | None = None  # step of the teacher's first decision
        self._observations: list[dict[str, Array]] = []
        self._actions: list[Array] = []
        self._rewards: list[float] = []
        self._successes: list[bool | None] = []
        self._discrepancies: list[float] = []
        self._shifts: list[float] = []

    @property
    def n_steps(self) -> int:
        """Number of steps so far."""
        return len(self._actions)

    @property
    def student_acts(self) -> bool:
        """Whether the student makes the next decision."""
        return len(self._actions) < self._student_steps

    def observe(self, observation: dict[str, Tensor]) -> None:
        """Append an observation; the first one fills the whole history, as LeRobot's policies do."""
        self.history.append(observation)
        while len(self.history) < (self.history.maxlen or 1):
            self.history.append(observation)

    def plan(self, chunks: ChunkBatch, row: int) -> None:
        """Queue one row of a decision."""
        if self._takeover is None and not self.student_acts:
            self._takeover = len(self._actions)
        recorded = chunks.actions if chunks.recorded is None else chunks.recorded
        self.queue.extend(zip(chunks.actions[row].cpu(), recorded[row].cpu(), strict=True))
        self._discrepancies.append(float(chunks.discrepancy[row]))
        self._shifts.append(float(chunks.guidance_shift[row]))

    def record(self, action: Array, reward: float, success: bool | None) -> None:
        """Append a step: the latest observation, the action, and what came of it."""
        # As they will be kept: a float32 image takes four times the memory, and episodes are long.
        self._observations.append({key: as_recorded(value) for key, value in self.history[-1].items()})
        self._actions.append(action)
        self._rewards.append(reward)
        self._successes.append(success)

    def finish(self, task: str) -> Episode:
        """The episode as arrays, without the student's part; an episode that the student finished alone is whole."""
        alone = self._takeover is None
        takeover = len(self._actions) if self._takeover is None else self._takeover
        first = 0 if alone else takeover
        successes = self._successes[first:]
        keys = self._observations[0].keys()
        return Episode(
            spec=self.spec,
            task=task,
            observations={key: np.stack([step[key] for step in self._observations[first:]]) for key in keys},
            actions=np.stack(self._actions[first:]).astype(np.float32),
            rewards=np.array(self._rewards[first:], dtype=np.float32),
            successes=None if None in successes else np.array(successes, dtype=bool),
            discrepancy=_mean(self._discrepancies),
            guidance_shift=_mean(self._shifts),
            student_steps=takeover,
            student_alone=alone,
        )

    def give_up(self, task: str, problem: str) -> Episode:
        """The episode without its observations and actions, and why it was not finished."""
        return Episode(
            spec=self.spec,
            task=task,
            observations={},
            actions=np.zeros((self.n_steps, 0), dtype=np.float32),
            rewards=np.array(self._rewards, dtype=np.float32),
            successes=None,
            problem=problem,
        )


def as_recorded(value: Tensor) -> Array:
    """Vectors as float32, images (C, H, W) in [0, 1] as uint8 (H, W, C)."""
    if value.ndim == 3:
        return (value * 255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    return value.float().cpu().numpy()


def _mean(values: Sequence[float]) -> float:
    """Mean over the decisions that have a value; NaN if none has."""
    finite = [value for value in values if value == value]
    return float(np.mean(finite)) if finite else float("nan")
