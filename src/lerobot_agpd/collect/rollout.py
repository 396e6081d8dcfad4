"""Rollouts in a vector environment that starts the next episode in every slot that finishes one."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.replay.episode import Array, Episode, Ticket


@dataclass(frozen=True)
class Decision:
    """Chunks to execute.

    Attributes:
        actions: (B, n, A) in the environment's units.
        j: (B,) discrepancy between what is executed and the student's chunk; NaN without a student.
        shift: (B,) mean shift of the guided denoising steps in sigmas; NaN where unguided.
    """

    actions: Tensor
    j: Tensor
    shift: Tensor


class Decider(Protocol):
    """A collection strategy: observation histories in, chunks out."""

    @property
    def n_obs_steps(self) -> int:
        """Length of the observation history it needs."""
        ...

    def decide(self, history: Mapping[str, Tensor], scale: Tensor) -> Decision:
        """Chunks for histories (B, n_obs, ...) of raw observations under guidance scales (B,)."""
        ...


@dataclass
class Stopwatch:
    """Seconds spent, by name."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the time spent inside to `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


class _Slot:
    """What one sub-environment's running episode has gathered so far."""

    def __init__(self, ticket: Ticket, n_obs_steps: int):
        self.ticket = ticket
        self.history: deque[dict[str, Tensor]] = deque(maxlen=n_obs_steps)
        self.queue: deque[Tensor] = deque()
        self.observations: list[dict[str, Tensor]] = []
        self.actions: list[Array] = []
        self.rewards: list[float] = []
        self.successes: list[bool | None] = []
        self.j: list[float] = []
        self.shift: list[float] = []

    def see(self, observation: dict[str, Tensor]) -> None:
        """Append an observation; the first one fills the whole history, as LeRobot's policies do."""
        self.history.append(observation)
        while len(self.history) < (self.history.maxlen or 1):
            self.history.append(observation)

    def finish(self, task: str) -> Episode:
        keys = self.observations[0].keys()
        return Episode(
            ticket=self.ticket,
            task=task,
            observations={
                key: np.stack([_as_recorded(step[key]) for step in self.observations]) for key in keys
            },
            actions=np.stack(self.actions).astype(np.float32),
            rewards=np.array(self.rewards, dtype=np.float32),
            successes=None if None in self.successes else np.array(self.successes, dtype=bool),
            j=float(np.mean(self.j)),
            shift=float(np.mean(self.shift)),
        )


class Rollouts:
    """Collects episodes with a strategy.

    Args:
        envs: LeRobot vector environment.
        processors: LeRobot's environment pre- and postprocessor.
        decider: the strategy.
        stopwatch: takes the time of decisions and environments apart.
    """

    def __init__(
        self,
        envs: gym.vector.VectorEnv,
        processors: tuple[Any, Any],
        decider: Decider,
        stopwatch: Stopwatch | None = None,
    ):
        self.envs = envs
        self.preprocess, self.postprocess = processors
        self.decider = decider
        self.stopwatch = stopwatch or Stopwatch()
        self.task = _task_description(envs)
        self._was_reset = False

    @torch.no_grad()
    def run(self, tickets: Iterable[Ticket]) -> Iterator[Episode]:
        """Yield episodes as they finish; slots without a further ticket idle until the last one is done."""
        waiting = iter(tickets)
        slots: list[_Slot | None] = [None] * self.envs.num_envs
        fresh = list(range(len(slots)))
        while True:
            if fresh:
                self._start(slots, fresh, waiting)
            if not any(slots):
                return
            self._decide(slots)
            observations, finished = self._step(slots)
            for number, episode in finished:
                slots[number] = None
                yield episode
            fresh = [number for number, _ in finished]
            for number, slot in enumerate(slots):
                if slot is not None:
                    slot.see(_row(observations, number))

    def _start(self, slots: list[_Slot | None], fresh: list[int], waiting: Iterator[Ticket]) -> None:
        """Reset the fresh slots for which a ticket is left."""
        mask = np.zeros(len(slots), dtype=bool)
        seeds: Any = [None] * len(slots)
        for number in fresh:
            ticket = next(waiting, None)
            if ticket is not None:
                slots[number] = _Slot(ticket, self.decider.n_obs_steps)
                mask[number], seeds[number] = True, ticket.seed
        if not mask.any():
            return
        if not self._was_reset:
            mask[:] = True  # sub-environments without a ticket need an observation too
            self._was_reset = True
        with self.stopwatch.measure("environment"):
            raw, _ = self.envs.reset(seed=seeds, options={"reset_mask": mask, NEW_ROLLOUT_OPTION: True})
            observations = self._observe(raw)
        for number in fresh:
            slot = slots[number]
            if slot is not None:
                slot.see(_row(observations, number))

    def _observe(self, raw: Any) -> dict[str, Tensor]:
        """LeRobot's observation features, tensors (n_envs, ...) only."""
        processed = self.preprocess(preprocess_observation(raw))
        return {key: value.clone() for key, value in processed.items() if isinstance(value, Tensor)}

    def _decide(self, slots: list[_Slot | None]) -> None:
        """Fill the empty action queues, all of them in one batched decision."""
        undecided = [slot for slot in slots if slot is not None and not slot.queue]
        if not undecided:
            return
        history = {
            key: torch.stack([torch.stack([step[key] for step in slot.history]) for slot in undecided])
            for key in undecided[0].history[0]
        }
        scale = torch.tensor([slot.ticket.scale for slot in undecided])
        with self.stopwatch.measure("decisions"):
            decision = self.decider.decide(history, scale)
        if not torch.isfinite(decision.actions).all():
            raise FloatingPointError(
                "a chunk to be executed is not finite: the teacher or the student has diverged (look at the loss, "
                "or lower the learning rate); episodes kept so far are safe"
            )
        for row, slot in enumerate(undecided):
            slot.queue.extend(decision.actions[row].cpu())
            slot.j.append(float(decision.j[row]))
            slot.shift.append(float(decision.shift[row]))

    def _step(self, slots: list[_Slot | None]) -> tuple[dict[str, Tensor], list[tuple[int, Episode]]]:
        """Execute one action in every environment."""
        idle = torch.from_numpy(np.zeros(self.envs.single_action_space.shape, dtype=np.float32))
        actions = torch.stack([slot.queue.popleft() if slot is not None else idle for slot in slots])
        executed: Array = self.postprocess({ACTION: actions})[ACTION].cpu().numpy()
        with self.stopwatch.measure("environment"):
            raw, rewards, terminated, truncated, info = self.envs.step(executed)
            observations = self._observe(raw)
        done = terminated | truncated
        finished = []
        for number, slot in enumerate(slots):
            if slot is None:
                continue
            slot.observations.append(slot.history[-1])
            slot.actions.append(executed[number])
            slot.rewards.append(float(rewards[number]))
            slot.successes.append(_success(info, number, bool(done[number])))
            if done[number]:
                finished.append((number, slot.finish(self.task)))
        return observations, finished


def _row(observations: dict[str, Tensor], number: int) -> dict[str, Tensor]:
    return {key: value[number] for key, value in observations.items()}


def _as_recorded(value: Tensor) -> Array:
    """Vectors as float32, images (C, H, W) in [0, 1] as uint8 (H, W, C)."""
    if value.ndim == 3:
        return (value * 255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    return value.float().cpu().numpy()


def _success(info: Mapping[str, Any], number: int, done: bool) -> bool | None:
    """`is_success` of one sub-environment, None if it reports none.

    With SAME_STEP autoreset the info of a finished episode is in `final_info`.
    """
    source = info["final_info"] if done and "final_info" in info else info
    values = source.get("is_success")
    reported = source.get("_is_success")
    if values is None or (reported is not None and not reported[number]):
        return None
    return bool(values[number])


def _task_description(envs: Any) -> str:
    for name in ("task_description", "task"):
        try:
            return str(envs.get_attr(name)[0])
        except AttributeError:
            continue
    return ""
