"""Episodes of a scripted expert as dataset frames, and the count of what happened to the attempts."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.utils.constants import ACTION, DONE, REWARD, SUCCESS
from lerobot.utils.utils import flatten_dict
from rich.table import Table

from lerobot_agpd.studies.statistics import Estimate, success_rate
from lerobot_agpd.envs.experts.base import Observation

Frame = dict[str, Any]


@dataclass
class DemosReport:
    """What happened to the attempts; written to `meta/demos.json` in the dataset.

    Attributes:
        task: the environment's task.
        seeds: environment seed of every recorded episode, in order.
        trivial_seeds: seeds skipped because the goal was reached before the first step.
        failed_seeds: seeds whose goal was not reached at the last step.
        skills: skill of every recorded episode, in order.
        failed_skills: skill of every failed one.
        frames: recorded frames.
    """

    task: str
    seeds: list[int] = field(default_factory=list)
    trivial_seeds: list[int] = field(default_factory=list)
    failed_seeds: list[int] = field(default_factory=list)
    skills: list[float] = field(default_factory=list)
    failed_skills: list[float] = field(default_factory=list)
    frames: int = 0

    @property
    def attempts(self) -> int:
        """Episodes begun, those with a trivial start included."""
        return len(self.seeds) + len(self.trivial_seeds) + len(self.failed_seeds)

    @property
    def operators(self) -> list[float]:
        """Skills that were played, the best first."""
        return sorted({*self.skills, *self.failed_skills}, reverse=True)

    def success_rate(self, skill: float | None = None) -> Estimate:
        """Share of episodes with the goal reached at the last step, without trivial starts, with Wilson's interval.

        Episodes are played until enough succeed, so the last one always does; over few episodes that flatters.

        Args:
            skill: of the operator whose episodes count; all by default.

        Raises:
            ValueError: if no such episode was played.
        """
        if skill is None:
            return _share(len(self.seeds), len(self.failed_seeds))
        return _share(self.skills.count(skill), self.failed_skills.count(skill))

    @property
    def recorded_share(self) -> Estimate:
        """Recorded episodes per attempt, trivial starts included, with Wilson's interval."""
        return _share(len(self.seeds), self.attempts - len(self.seeds))

    def to_table(self) -> Table:
        """Lay the counts out for the console."""
        table = Table("scripted expert", self.task)
        table.add_row("attempts", str(self.attempts))
        table.add_row("skipped: goal reached at the start", str(len(self.trivial_seeds)))
        table.add_row("dropped: failed", str(len(self.failed_seeds)))
        table.add_row("recorded episodes", str(len(self.seeds)))
        table.add_row("recorded frames", str(self.frames))
        table.add_row("recorded per attempt", _with_count(self.recorded_share))
        table.add_row("success rate without trivial starts", _with_count(self.success_rate()))
        for skill in self.operators if self.operators != [1.0] else []:
            table.add_row(f"  skill {skill:g}", _with_count(self.success_rate(skill)))
        return table


def _share(successes: int, failures: int) -> Estimate:
    return success_rate([True] * successes + [False] * failures)


def _with_count(estimate: Estimate) -> str:
    """E.g. `0.91 [0.86, 0.94], N = 120`."""
    return f"{estimate}, N = {estimate.n}"


def play_episode(
    env: gym.Env, expert: Callable[[Observation], np.ndarray], seed: int, features_map: dict[str, str]
) -> list[Frame] | None:
    """Let the expert play one episode to its end.

    Args:
        env: a single environment with LeRobot's raw keys, and with the attribute `state` for the expert.
        expert: maps a raw state observation to an action.
        seed: environment seed of the reset.
        features_map: raw key to dataset key.

    Returns:
        One dataset frame per step, or None if the goal is reached before the first step.
    """
    observation, info = env.reset(seed=seed)
    if info["is_success"]:
        return None
    frames: list[Frame] = []
    done = False
    while not done:
        action = expert(env.get_wrapper_attr("state"))
        frame = {features_map[key]: value for key, value in flatten_dict(observation).items()}
        observation, reward, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        frame[ACTION] = action
        frame[REWARD] = np.array([reward], dtype=np.float32)
        frame[SUCCESS] = np.array([info["is_success"]], dtype=bool)
        frame[DONE] = np.array([done], dtype=bool)
        frames.append(frame)
    return frames
