"""Base of the scripted experts: intentions of hands, and a body that turns them into actions."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE

Array = NDArray[np.float64]
Observation = dict[str, np.ndarray]


def ramp(value: float, zero_at: float, one_at: float) -> float:
    """Rise linearly from 0 at `zero_at` to 1 at `one_at` (or fall, if `one_at` is the smaller), clipped."""
    return float(np.clip((value - zero_at) / (one_at - zero_at), 0.0, 1.0))


def descend(to_grasp: Array, clearance: float, fingers_shut: float) -> Array:
    """Displacement (3,) that comes down onto a grasp in a funnel.

    The hand keeps a height that falls with the horizontal distance to the grasp and with the opening of the fingers.

    Args:
        to_grasp: (3,) from where the hand is to where it closes.
        clearance: largest height above the grasp, meters.
        fingers_shut: 1 where the fingers have to open before they come down, 0 where they are open.
    """
    sideways = float(np.linalg.norm(to_grasp[:2]))
    height = clearance * max(ramp(sideways, zero_at=0.008, one_at=0.05), fingers_shut)
    return to_grasp + np.array([0.0, 0.0, height])


def state_vectors(
    observation: Observation, agent_pos_dim: int, environment_state_dim: int
) -> tuple[Array, Array]:
    """Return `agent_pos` (agent_pos_dim,) and `environment_state` (environment_state_dim,) in float64.

    Raises:
        ValueError: if the shapes differ, for instance because the observation is batched.
    """
    vectors = []
    for key, dim in ((AGENT_POS, agent_pos_dim), (ENVIRONMENT_STATE, environment_state_dim)):
        vectors.append(np.asarray(observation[key], dtype=np.float64))
        if vectors[-1].shape != (dim,):
            raise ValueError(f"Expected {key} ({dim},) of a single environment, got {vectors[-1].shape}.")
    return vectors[0], vectors[1]


def _only_hand(observation: Observation) -> Array:
    return np.asarray(observation[AGENT_POS][:3], dtype=np.float64)[None]  # (1, 3)


def _as_action(observation: Observation, intention: Array) -> np.ndarray:
    return np.clip(intention.reshape(-1), -1.0, 1.0).astype(np.float32)


@dataclass(frozen=True)
class Expert:
    """A scripted expert: a pure function from one raw observation of a single environment to an action.

    It has two parts, so that operators of limited skill (`envs.operators`) can disturb the hands of any robot. The
    defaults fit a robot with one hand whose action is the intention itself.

    Attributes:
        intend: observation to the intention of every hand, (H, 4) or (4,) for one hand: a displacement x, y, z in
            [-1, 1], 1 being the fastest motion of the hand, and the gripper.
        hands: observation to the positions (H, 3) of the hands, meters.
        act: observation and intention (H, 4) to the environment's action (A,), float32.
    """

    intend: Callable[[Observation], np.ndarray]
    hands: Callable[[Observation], Array] = _only_hand
    act: Callable[[Observation, Array], np.ndarray] = _as_action

    def intentions(self, observation: Observation) -> Array:
        """Intention of every hand, (H, 4)."""
        return np.atleast_2d(np.asarray(self.intend(observation), dtype=np.float64))

    def for_episode(self, rng: np.random.Generator) -> Self:
        """Expert of one episode: itself, since it has no memory and draws nothing."""
        return self

    def __call__(self, observation: Observation) -> np.ndarray:
        """Action (A,), float32."""
        return self.act(observation, self.intentions(observation))
