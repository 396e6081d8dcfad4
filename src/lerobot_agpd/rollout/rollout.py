"""Rollouts in a vector environment that starts the next episode in every slot that finishes one."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.guidance.teacher import TASK, History
from lerobot_agpd.replay.episode import Array, Episode, EpisodeSpec
from lerobot_agpd.rollout.running_episode import RunningEpisode, as_recorded
from lerobot_agpd.rollout.strategies import ChunkBatch, Strategy
from lerobot_agpd.rollout.watched import StuckEnvironmentsError, WatchedEnvs

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Decision:
    """One batched decision of a strategy, as `on_decision` is told of it.

    Attributes:
        history: raw observations (B, n_obs_steps, ...) and tasks that it was made at.
        strength: (B,) pulls, guidance scales or mixing weights.
        student_acts: (B,) bool, True where the student acted.
        chunks: what was decided.
        noise: state of the strategy's generator before it; drawing from it again gives the same noise.
    """

    history: History
    strength: Tensor
    student_acts: Tensor
    chunks: ChunkBatch
    noise: Tensor


class Rollouts:
    """Collects episodes with a strategy.

    Args:
        envs: LeRobot vector environment.
        processors: LeRobot's environment pre- and postprocessor.
        strategy: decides; its stopwatch takes the environments' time too.
        on_decision: told of every decision.
        check: raises if an episode's first observation (vectors (D,), images (H, W, C)) could not be kept.
        max_steps: an episode that its environment has not ended after so many steps is cut off.
        step_timeout: seconds that a reset or a step may take; None: any time.

    Attributes:
        problem: why the environments got stuck; None if they did not.
    """

    def __init__(
        self,
        envs: gym.vector.VectorEnv,
        processors: tuple[Any, Any],
        strategy: Strategy,
        on_decision: Callable[[Decision], None] | None = None,
        check: Callable[[Mapping[str, Array]], None] | None = None,
        max_steps: float = math.inf,
        step_timeout: float | None = None,
    ):
        self.envs, self.watched = envs, WatchedEnvs(envs, step_timeout)
        self.preprocess, self.postprocess = processors
        self.strategy = strategy
        self.on_decision = on_decision
        self.check = check
        self.max_steps = max_steps
        self.task = _task_description(envs)
        self.problem: str | None = None
        self._was_reset = False
        self._has_cut = False

    @torch.no_grad()
    def run(self, specs: Iterable[EpisodeSpec]) -> Iterator[Episode]:
        """Yield episodes as they finish; slots without a further episode idle until the last one is done.

        If environments get stuck, the episodes that run in them are yielded with what is wrong, and no others: the vector
        environment cannot be used again.
        """
        running: list[RunningEpisode | None] = [None] * self.envs.num_envs
        with self.watched.watching():
            try:
                yield from self._run(running, iter(specs))
            except StuckEnvironmentsError as stuck:
                self.problem = stuck.problem
                for slot in stuck.slots:
                    entry = running[slot]
                    if entry is not None:
                        yield entry.give_up(self.task, stuck.problem)

    def _run(self, running: list[RunningEpisode | None], waiting: Iterator[EpisodeSpec]) -> Iterator[Episode]:
        free = list(range(len(running)))
        while True:
            if free:
                self._start(running, free, waiting)
            if not any(running):
                return
            self._decide(running)
            observations, finished = self._step(running)
            for slot, episode in finished:
                running[slot] = None
                yield episode
            free = [slot for slot, _ in finished]
            for slot, entry in enumerate(running):
                if entry is not None:
                    entry.observe(_row(observations, slot))

    def _start(
        self, running: list[RunningEpisode | None], free: list[int], waiting: Iterator[EpisodeSpec]
    ) -> None:
        """Reset the free slots for which an episode is left."""
        mask = np.zeros(len(running), dtype=bool)
        seeds: Any = [None] * len(running)
        for slot in free:
            spec = next(waiting, None)
            if spec is not None:
                running[slot] = RunningEpisode(spec, self.strategy.n_obs_steps, self._student_steps(spec))
                mask[slot], seeds[slot] = True, spec.seed
        if not mask.any():
            return
        if not self._was_reset:
            mask[:] = True  # sub-environments without an episode need an observation too
            self._was_reset = True
        with self.strategy.stopwatch.measure("environment"):
            options = {"reset_mask": mask, NEW_ROLLOUT_OPTION: True}
            raw, _ = self.watched.reset(seed=seeds, options=options)
            observations = self._observe(raw)
        for slot in free:
            entry = running[slot]
            if entry is not None:
                observation = _row(observations, slot)
                if self.check is not None:
                    self.check({key: as_recorded(value) for key, value in observation.items()})
                entry.observe(observation)

    def _student_steps(self, spec: EpisodeSpec) -> int:
        """Steps after which the student hands over."""
        if not spec.student_fraction:
            return 0
        limit = step_limit(self.envs)
        if limit is None:
            raise ValueError(
                "--policy.collect.strategy=rollin gives the student a fraction of the longest episode, and the environment "
                "does not say after how many steps it ends one (no _max_episode_steps); use another strategy"
            )
        return round(spec.student_fraction * limit)

    def _observe(self, raw: Any) -> dict[str, Tensor]:
        """LeRobot's observation features, tensors (n_envs, ...) only."""
        processed = self.preprocess(preprocess_observation(raw))
        return {key: value.clone() for key, value in processed.items() if isinstance(value, Tensor)}

    def _decide(self, running: Sequence[RunningEpisode | None]) -> None:
        """Fill the empty action queues, all of them in one batched decision."""
        undecided = [entry for entry in running if entry is not None and not entry.queue]
        if not undecided:
            return
        history: dict[str, Any] = {
            key: _finite(
                torch.stack([torch.stack([step[key] for step in entry.history]) for entry in undecided])
            )
            for key in undecided[0].history[0]
        }
        history[TASK] = [self.task] * len(undecided)
        strength = torch.tensor([entry.spec.strength for entry in undecided])
        student_acts = torch.tensor([entry.student_acts for entry in undecided])
        noise = self.strategy.generator.get_state()
        chunks = self.strategy.act(history, strength, student_acts)
        if not torch.isfinite(chunks.actions).all():
            raise FloatingPointError(
                "a chunk to be executed is not finite: the teacher or the student has diverged (look at the loss, "
                "or lower the learning rate); episodes kept so far are safe"
            )
        if self.on_decision is not None:
            self.on_decision(Decision(history, strength, student_acts, chunks, noise))
        for row, entry in enumerate(undecided):
            entry.plan(chunks, row)

    def _step(
        self, running: Sequence[RunningEpisode | None]
    ) -> tuple[dict[str, Tensor], list[tuple[int, Episode]]]:
        """Execute one action in every environment."""
        idle = torch.from_numpy(np.zeros(self.envs.single_action_space.shape, dtype=np.float32))
        planned = [entry.queue.popleft() if entry is not None else (idle, idle) for entry in running]
        executed = self._for_environment([action for action, _ in planned])
        recorded = self._for_environment([action for _, action in planned])
        with self.strategy.stopwatch.measure("environment"):
            raw, rewards, terminated, truncated, info = self.watched.step(executed)
            observations = self._observe(raw)
        done = terminated | truncated
        finished = []
        for slot, entry in enumerate(running):
            if entry is None:
                continue
            entry.record(recorded[slot], float(rewards[slot]), _success(info, slot, bool(done[slot])))
            is_cut = not done[slot] and entry.n_steps >= self.max_steps
            if is_cut and not self._has_cut:
                self._has_cut = True
                logger.warning(
                    "an episode (environment seed %d) is cut off after %d steps: its environment has not ended it; further "
                    "ones are cut off alike (--policy.collect.max_episode_steps)",
                    entry.spec.seed,
                    entry.n_steps,
                )
            if done[slot] or is_cut:
                finished.append((slot, entry.finish(self.task)))
        return observations, finished

    def _for_environment(self, actions: Sequence[Tensor]) -> Array:
        """Actions (n_envs, A) as the environment takes them."""
        processed: Tensor = self.postprocess({ACTION: torch.stack(list(actions))})[ACTION]
        return processed.cpu().numpy()


def step_limit(envs: gym.vector.VectorEnv) -> int | None:
    """Steps after which an environment ends its episodes, where LeRobot's own evaluation looks for them; None if unknown."""
    try:
        return int(_attribute(envs, "_max_episode_steps"))
    except (AttributeError, TypeError):
        return None


def _attribute(envs: gym.vector.VectorEnv, name: str) -> Any:
    """An attribute of the first sub-environment; synchronous and asynchronous ones have it, their base class not."""
    get_attr: Callable[[str], tuple[Any, ...]] = envs.get_attr  # type: ignore[attr-defined]
    return get_attr(name)[0]


def _row(observations: dict[str, Tensor], row: int) -> dict[str, Tensor]:
    return {key: value[row] for key, value in observations.items()}


def _finite(values: Tensor) -> Tensor:
    """Vectors (B, T, D) with zeros for what is not finite: such an episode is dropped, and must not end the run before."""
    return torch.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0) if values.ndim == 3 else values


def _success(info: Mapping[str, Any], slot: int, done: bool) -> bool | None:
    """`is_success` of one sub-environment, None if it reports none.

    With SAME_STEP autoreset the info of a finished episode is in `final_info`.
    """
    source = info["final_info"] if done and "final_info" in info else info
    values = source.get("is_success")
    reported = source.get("_is_success")
    if values is None or (reported is not None and not reported[slot]):
        return None
    return bool(values[slot])


def _task_description(envs: gym.vector.VectorEnv) -> str:
    for name in ("task_description", "task"):
        try:
            return str(_attribute(envs, name))
        except AttributeError:
            continue
    return ""
