"""Rollouts in a vector environment that starts the next episode in every slot that finishes one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.collect.config import RollinConfig
from lerobot_agpd.collect.decider import Decider
from lerobot_agpd.collect.slot import Slot, as_recorded
from lerobot_agpd.guidance.teacher import TASK
from lerobot_agpd.replay.episode import Array, Episode, Ticket


class Rollouts:
    """Collects episodes with a strategy.

    Args:
        envs: LeRobot vector environment.
        processors: LeRobot's environment pre- and postprocessor.
        decider: the strategy; its stopwatch takes the environments' time too.
        rollin: what to make of the first part of an episode, in which the student acts.
        check: raises if an episode's first observation (vectors (D,), images (H, W, C)) could not be kept.
    """

    def __init__(
        self,
        envs: gym.vector.VectorEnv,
        processors: tuple[Any, Any],
        decider: Decider,
        rollin: RollinConfig | None = None,
        check: Callable[[Mapping[str, Array]], None] | None = None,
    ):
        self.envs = envs
        self.preprocess, self.postprocess = processors
        self.decider = decider
        self.rollin = rollin or RollinConfig()
        self.check = check
        self.task = _task_description(envs)
        self._was_reset = False

    @torch.no_grad()
    def run(self, tickets: Iterable[Ticket]) -> Iterator[Episode]:
        """Yield episodes as they finish; slots without a further ticket idle until the last one is done."""
        waiting = iter(tickets)
        slots: list[Slot | None] = [None] * self.envs.num_envs
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

    def _start(self, slots: list[Slot | None], fresh: list[int], waiting: Iterator[Ticket]) -> None:
        """Reset the fresh slots for which a ticket is left."""
        mask = np.zeros(len(slots), dtype=bool)
        seeds: Any = [None] * len(slots)
        for number in fresh:
            ticket = next(waiting, None)
            if ticket is not None:
                slots[number] = Slot(ticket, self.decider.n_obs_steps, self._student_steps(ticket))
                mask[number], seeds[number] = True, ticket.seed
        if not mask.any():
            return
        if not self._was_reset:
            mask[:] = True  # sub-environments without a ticket need an observation too
            self._was_reset = True
        with self.decider.stopwatch.measure("environment"):
            raw, _ = self.envs.reset(seed=seeds, options={"reset_mask": mask, NEW_ROLLOUT_OPTION: True})
            observations = self._observe(raw)
        for number in fresh:
            slot = slots[number]
            if slot is not None:
                observation = _row(observations, number)
                if self.check is not None:
                    self.check({key: as_recorded(value) for key, value in observation.items()})
                slot.see(observation)

    def _student_steps(self, ticket: Ticket) -> int:
        """Steps after which the teacher takes over."""
        if ticket.student_share == 0:
            return 0
        limit = self.rollin.episode_steps or step_limit(self.envs)
        return round(ticket.student_share * limit)

    def _observe(self, raw: Any) -> dict[str, Tensor]:
        """LeRobot's observation features, tensors (n_envs, ...) only."""
        processed = self.preprocess(preprocess_observation(raw))
        return {key: value.clone() for key, value in processed.items() if isinstance(value, Tensor)}

    def _decide(self, slots: Sequence[Slot | None]) -> None:
        """Fill the empty action queues, all of them in one batched decision."""
        undecided = [slot for slot in slots if slot is not None and not slot.queue]
        if not undecided:
            return
        history: dict[str, Any] = {
            key: torch.stack([torch.stack([step[key] for step in slot.history]) for slot in undecided])
            for key in undecided[0].history[0]
        }
        history[TASK] = [self.task] * len(undecided)
        strength = torch.tensor([slot.ticket.scale for slot in undecided])
        rolling_in = torch.tensor([slot.rolling_in for slot in undecided])
        decision = self.decider.decide(history, strength, rolling_in)
        if not torch.isfinite(decision.actions).all():
            raise FloatingPointError(
                "a chunk to be executed is not finite: the teacher or the student has diverged (look at the loss, "
                "or lower the learning rate); episodes kept so far are safe"
            )
        for row, slot in enumerate(undecided):
            slot.plan(decision, row)

    def _step(self, slots: Sequence[Slot | None]) -> tuple[dict[str, Tensor], list[tuple[int, Episode]]]:
        """Execute one action in every environment."""
        idle = torch.from_numpy(np.zeros(self.envs.single_action_space.shape, dtype=np.float32))
        planned = [slot.queue.popleft() if slot is not None else (idle, idle) for slot in slots]
        executed = self._for_environment([action for action, _ in planned])
        recorded = self._for_environment([action for _, action in planned])
        with self.decider.stopwatch.measure("environment"):
            raw, rewards, terminated, truncated, info = self.envs.step(executed)
            observations = self._observe(raw)
        done = terminated | truncated
        finished = []
        for number, slot in enumerate(slots):
            if slot is None:
                continue
            slot.record(recorded[number], float(rewards[number]), _success(info, number, bool(done[number])))
            if done[number]:
                finished.append((number, slot.finish(self.task, self.rollin.record_student)))
        return observations, finished

    def _for_environment(self, actions: Sequence[Tensor]) -> Array:
        """Actions (n_envs, A) as the environment takes them."""
        processed: Tensor = self.postprocess({ACTION: torch.stack(list(actions))})[ACTION]
        return processed.cpu().numpy()


def step_limit(envs: Any) -> int:
    """Steps after which the environment cuts an episode off, where LeRobot's own evaluation looks for them.

    Raises:
        ValueError: if it does not say.
    """
    try:
        return int(envs.get_attr("_max_episode_steps")[0])
    except (AttributeError, TypeError) as error:
        raise ValueError(
            "the environment does not say after how many steps it ends an episode (no _max_episode_steps), so a "
            "share of an episode cannot be given to the student; say it with --policy.collect.rollin.episode_steps"
        ) from error


def _row(observations: dict[str, Tensor], number: int) -> dict[str, Tensor]:
    return {key: value[number] for key, value in observations.items()}


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
