"""What a scripted expert is: intentions of hands, and a body that turns them into actions."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_agpd.envs.base import AGENT_POS

Array = NDArray[np.float64]
Observation = dict[str, np.ndarray]


def ramp(value: float, zero_at: float, one_at: float) -> float:
    """Rise linearly from 0 at `zero_at` to 1 at `one_at` (or fall, if `one_at` is the smaller), clipped."""
    return float(np.clip((value - zero_at) / (one_at - zero_at), 0.0, 1.0))


def _only_hand(observation: Observation) -> Array:
    return np.asarray(observation[AGENT_POS][:3], dtype=np.float64)[None]  # (1, 3)


def _as_action(observation: Observation, intention: Array) -> np.ndarray:
    return np.clip(intention.reshape(-1), -1.0, 1.0).astype(np.float32)


@dataclass(frozen=True)
class Expert:
    """A scripted expert: a pure function from one raw observation of a single environment to an action.

    It is told in two parts, so that operators of limited skill (`envs.operators`) can disturb what the hands do
    whatever the robot. The defaults fit a robot with one hand whose action is the intention itself.

    Attributes:
        intend: observation to what every hand shall do, (H, 4) or (4,) for one hand: a displacement x, y, z in
            [-1, 1], 1 being the fastest motion of the hand, and the gripper.
        hands: observation to the positions (H, 3) of the hands, metres.
        act: observation and intention (H, 4) to the environment's action (A,), float32.
    """

    intend: Callable[[Observation], np.ndarray]
    hands: Callable[[Observation], Array] = _only_hand
    act: Callable[[Observation, Array], np.ndarray] = _as_action

    def intentions(self, observation: Observation) -> Array:
        """What every hand shall do, (H, 4)."""
        return np.atleast_2d(np.asarray(self.intend(observation), dtype=np.float64))

    def __call__(self, observation: Observation) -> np.ndarray:
        """Action (A,), float32."""
        return self.act(observation, self.intentions(observation))
