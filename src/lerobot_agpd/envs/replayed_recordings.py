"""Recorded actions played again in the environment, as dataset frames."""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from lerobot.utils.constants import DONE, OBS_ENV_STATE, OBS_STATE, SUCCESS

from lerobot_agpd.dataset_writer import Frame
from lerobot_agpd.envs.dapg_recordings import Recording
from lerobot_agpd.envs.demonstrations import play_step
from lerobot_agpd.envs.robotics_tasks import TASKS


@dataclass(frozen=True)
class Replay:
    """One recording, played again.

    Attributes:
        frames: one per step; observations, rewards and successes are the environment's.
        success_at_any_step: whether the environment's goal was reached.
        success_at_last_step: whether it held at the end.
        deviations: (T,) mean absolute difference between the observations shown and recorded, step by step.
        clipped: fraction of the recorded numbers that lay outside of the action space.
    """

    frames: list[Frame]
    success_at_any_step: bool
    success_at_last_step: bool
    deviations: np.ndarray
    clipped: float


def executed_actions(recording: Recording) -> np.ndarray:
    """The recorded actions as the environment executes them, clipped to [-1, 1]; (T, A) float32."""
    return np.clip(recording.actions, -1, 1).astype(np.float32)


def replay(env: gym.Env, recording: Recording, features_map: dict[str, str]) -> Replay:
    """Play the recorded actions from the recorded state.

    Args:
        env: a single environment of the recording's task, with a step limit of at least the recording's length.
        recording: see `Recording`.
        features_map: raw key to dataset key.
    """
    spec = TASKS[recording.task]
    # The seed draws a start that the recorded one replaces.
    observation, _ = env.reset(seed=0, options={"initial_state_dict": recording.initial_state})
    frames: list[Frame] = []
    deviations = np.empty(len(recording))
    for step, action in enumerate(executed_actions(recording)):
        frame, observation = play_step(env, observation, action, features_map)
        recorded = np.concatenate(spec.split(recording.observations[step]))
        shown = np.concatenate([frame[OBS_STATE], frame[OBS_ENV_STATE]])
        deviations[step] = np.abs(shown - recorded).mean()
        frames.append(frame)
    frames[-1][DONE] = np.array([True])
    successes = [frame[SUCCESS].item() for frame in frames]
    return Replay(
        frames,
        success_at_any_step=any(successes),
        success_at_last_step=successes[-1],
        deviations=deviations,
        clipped=float((np.abs(recording.actions) > 1).mean()),
    )
