"""Successful episodes of a scripted expert as dataset frames, and the count of what happened to the attempts."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
from lerobot.configs import FeatureType
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, DONE, REWARD, SUCCESS
from lerobot.utils.utils import flatten_dict

from lerobot_agpd.dataset_writer import Feature, Frame, flag, image, vector
from lerobot_agpd.envs.experts.base import Expert, Observation
from lerobot_agpd.envs.experts.ways import WaysExpert
from lerobot_agpd.envs.operators import Operator

SKILL = "skill"
"""Feature of datasets whose operators are not all experts: the skill of the frame's operator."""


@dataclass
class DemosReport:
    """What happened to the attempts; written to `meta/demos.json` in the dataset.

    Attributes:
        task: the environment's task.
        seeds: environment seed of every recorded episode, in order.
        solved_at_start_seeds: seeds skipped because the goal was reached before the first step.
        failed_seeds: seeds whose goal was not reached at the last step.
        skills: skill of every recorded episode, in order.
        failed_skills: skill of every failed one.
        frames: recorded frames.
    """

    task: str
    seeds: list[int] = field(default_factory=list)
    solved_at_start_seeds: list[int] = field(default_factory=list)
    failed_seeds: list[int] = field(default_factory=list)
    skills: list[float] = field(default_factory=list)
    failed_skills: list[float] = field(default_factory=list)
    frames: int = 0

    @property
    def attempts(self) -> int:
        """Episodes begun, those that were solved at the start included."""
        return len(self.seeds) + len(self.solved_at_start_seeds) + len(self.failed_seeds)


def dataset_features(env: EnvConfig) -> dict[str, Feature]:
    """Features of a recorded frame: the environment's, reward, success and end of the episode."""
    observed = {
        env.features_map[key]: image(tuple(feature.shape))
        if feature.type is FeatureType.VISUAL
        else vector(*feature.shape)
        for key, feature in env.features.items()
    }
    return {**observed, REWARD: vector(1), SUCCESS: flag(), DONE: flag()}


def play_step(
    env: gym.Env, observation: Observation, action: np.ndarray, features_map: dict[str, str]
) -> tuple[Frame, Observation]:
    """Play one action.

    Args:
        env: a single environment with LeRobot's raw keys.
        observation: raw observation in which the action is played.
        action: (A,).
        features_map: raw key to dataset key.

    Returns:
        The dataset frame, whose reward, success and end are those of the state that the action leads to, and the raw
        observation of that state.
    """
    frame = {features_map[key]: value for key, value in flatten_dict(observation).items()}
    following, reward, terminated, truncated, info = env.step(action)
    frame["task"] = env.get_wrapper_attr("task_description")
    frame[ACTION] = action
    frame[REWARD] = np.array([reward], dtype=np.float32)
    frame[SUCCESS] = np.array([info["is_success"]], dtype=bool)
    frame[DONE] = np.array([terminated or truncated], dtype=bool)
    return frame, following


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
    while not frames or not frames[-1][DONE].item():
        frame, observation = play_step(env, observation, expert(env.get_wrapper_attr("state")), features_map)
        frames.append(frame)
    return frames


def successful_episodes(
    env: gym.Env,
    expert: Expert | WaysExpert,
    features_map: dict[str, str],
    skills: Sequence[float],
    n_episodes: int,
    seeds: range,
    report: DemosReport,
) -> Iterator[list[Frame]]:
    """Play seed after seed and yield episodes whose goal is reached at the last step.

    Operators take turns: the same one plays until an episode succeeds. Their noise follows from the first seed and the
    seed of the episode.

    Args:
        env: see `play_episode`.
        expert: of the environment's task.
        features_map: raw key to dataset key.
        skills: one skill per operator; `[1.0]` is the expert alone, without the feature `skill`.
        n_episodes: episodes to yield.
        seeds: environment seeds to try.
        report: updated on the way.

    Raises:
        RuntimeError: if too few episodes succeed.
    """
    for seed in seeds:
        skill = skills[len(report.seeds) % len(skills)]
        rng = np.random.default_rng([seeds[0], seed])
        operator = Operator(expert.for_episode(rng), skill, rng)
        frames = play_episode(env, operator, seed, features_map)
        if frames is None:
            report.solved_at_start_seeds.append(seed)
        elif not frames[-1][SUCCESS].item():
            report.failed_seeds.append(seed)
            report.failed_skills.append(skill)
        else:
            report.seeds.append(seed)
            report.skills.append(skill)
            report.frames += len(frames)
            if list(skills) != [1.0]:
                frames = [{**frame, SKILL: np.array([skill], dtype=np.float32)} for frame in frames]
            yield frames
            if len(report.seeds) == n_episodes:
                return
    raise RuntimeError(
        f"Only {len(report.seeds)} of {n_episodes} episodes succeeded in {report.attempts} attempts "
        f"({len(report.solved_at_start_seeds)} solved at the start, {len(report.failed_seeds)} failed), seeds "
        f"{seeds.start} to {seeds.stop - 1}. A less skilled operator needs a larger --env.episode_length."
    )
