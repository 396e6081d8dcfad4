"""A running episode."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.collect.decider import Decision
from lerobot_agpd.replay.episode import Array, Episode, Ticket


class Slot:
    """What one sub-environment's running episode has gathered so far.

    Attributes:
        ticket: the episode's.
        history: the last observations, oldest first.
        queue: steps decided and not yet executed: the action to execute and the one to record, (A,) each.
    """

    def __init__(self, ticket: Ticket, n_obs_steps: int, student_steps: int = 0):
        """Begin an episode in which the student acts until `student_steps` steps are executed."""
        self.ticket = ticket
        self.history: deque[dict[str, Tensor]] = deque(maxlen=n_obs_steps)
        self.queue: deque[tuple[Tensor, Tensor]] = deque()
        self._student_steps = student_steps
        self._takeover: int | None = None  # step of the teacher's first decision
        self._observations: list[dict[str, Array]] = []
        self._actions: list[Array] = []
        self._rewards: list[float] = []
        self._successes: list[bool | None] = []
        self._j: list[float] = []
        self._shift: list[float] = []

    @property
    def rolling_in(self) -> bool:
        """Whether the student makes the next decision."""
        return len(self._actions) < self._student_steps

    def see(self, observation: dict[str, Tensor]) -> None:
        """Append an observation; the first one fills the whole history, as LeRobot's policies do."""
        self.history.append(observation)
        while len(self.history) < (self.history.maxlen or 1):
            self.history.append(observation)

    def plan(self, decision: Decision, row: int) -> None:
        """Queue one row of a decision."""
        if self._takeover is None and not self.rolling_in:
            self._takeover = len(self._actions)
        recorded = decision.actions if decision.recorded is None else decision.recorded
        self.queue.extend(zip(decision.actions[row].cpu(), recorded[row].cpu(), strict=True))
        self._j.append(float(decision.j[row]))
        self._shift.append(float(decision.shift[row]))

    def record(self, action: Array, reward: float, success: bool | None) -> None:
        """Append a step: the latest observation and what was done and came of it."""
        # As they will be kept: a float32 image takes four times the memory, and episodes are long.
        self._observations.append({key: as_recorded(value) for key, value in self.history[-1].items()})
        self._actions.append(action)
        self._rewards.append(reward)
        self._successes.append(success)

    def finish(self, task: str, record_student: bool = False) -> Episode:
        """The episode as arrays.

        The steps before the teacher took over are left out unless `record_student`; an episode that the student
        finished alone is whole.
        """
        takeover = len(self._actions) if self._takeover is None else self._takeover
        alone = self._takeover is None
        first = 0 if record_student or alone else takeover
        successes = self._successes[first:]
        keys = self._observations[0].keys()
        return Episode(
            ticket=self.ticket,
            task=task,
            observations={key: np.stack([step[key] for step in self._observations[first:]]) for key in keys},
            actions=np.stack(self._actions[first:]).astype(np.float32),
            rewards=np.array(self._rewards[first:], dtype=np.float32),
            successes=None if None in successes else np.array(successes, dtype=bool),
            j=_mean(self._j),
            shift=_mean(self._shift),
            student_steps=takeover,
            student_alone=alone,
        )


def as_recorded(value: Tensor) -> Array:
    """Vectors as float32, images (C, H, W) in [0, 1] as uint8 (H, W, C)."""
    if value.ndim == 3:
        return (value * 255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    return value.float().cpu().numpy()


def _mean(values: Sequence[float]) -> float:
    """Mean over the decisions that have a value; NaN if none has."""
    known = [value for value in values if value == value]
    return float(np.mean(known)) if known else float("nan")
