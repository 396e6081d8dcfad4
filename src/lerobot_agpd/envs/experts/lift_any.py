"""Scripted experts for the tasks of `envs.lift_tasks`: draw a cube, come down onto it, grasp and lift it.

Which cube an episode takes no observation shows at its start: the demonstrations know several ways.
"""

from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_agpd.envs.base import AGENT_POS
from lerobot_agpd.envs.experts.base import Array, Expert, Observation, ramp, state_vectors
from lerobot_agpd.envs.experts.robomimic import CLOSE, OPEN, ROTATION_GAIN
from lerobot_agpd.envs.experts.ways import WaysExpert
from lerobot_agpd.envs.lift_tasks import TASKS

# Action units per meter of position error.
POSITION_GAIN = np.array([25.0, 25.0, 15.0])
# Largest action downward.
DESCENT = 0.6
# Height of the hand above the cube's center before it comes down to grasp, unless it is above the cube, meters.
CLEARANCE = 0.09
# Weights of an offset in x, y and z when the fingers close: along x they are as wide as the cube.
ALONG_FINGERS = np.array([0.5, 1.0, 1.0])
# Standard deviation of the displacement's noise, action units, and its correlation from one step to the next.
NOISE = 0.04
NOISE_CORRELATION = 0.8


class CubeLifter:
    """Lifts one cube in one episode."""

    def __init__(self, task: str, cube: int, rng: np.random.Generator) -> None:
        """Begin an episode.

        Args:
            task: key of `lift_tasks.TASKS`.
            cube: number of the cube.
            rng: source of the noise.
        """
        self._spec, self._cube, self._rng = TASKS[task], cube, rng
        self._noise: Array = np.zeros(3)

    def __call__(self, observation: Observation) -> Array:
        """Intention (4,): displacement and gripper."""
        agent, vectors = state_vectors(
            observation, self._spec.agent_pos_dim, self._spec.environment_state_dim
        )
        to_cube, width = vectors.reshape(-1, 3)[self._cube], float(agent[7] - agent[8])
        offset = ALONG_FINGERS * to_cube
        between_fingers = ramp(float(np.linalg.norm(offset)), zero_at=0.03, one_at=0.018)
        held = between_fingers * ramp(width, zero_at=0.055, one_at=0.048)
        beside = ramp(float(np.linalg.norm(offset[:2])), zero_at=0.015, one_at=0.05)
        height = CLEARANCE * max(beside, (1.0 - between_fingers) * ramp(width, zero_at=0.03, one_at=0.02))
        approach = POSITION_GAIN * (to_cube + [0.0, 0.0, height])
        approach[2] = max(approach[2], -DESCENT)
        displacement = (1.0 - held) * np.clip(approach, -1.0, 1.0) + held * np.array([0.0, 0.0, 1.0])
        return np.append(displacement + self._next_noise(), OPEN + (CLOSE - OPEN) * between_fingers)

    def _next_noise(self) -> Array:
        innovation = NOISE * np.sqrt(1.0 - NOISE_CORRELATION**2)
        self._noise = NOISE_CORRELATION * self._noise + innovation * self._rng.standard_normal(3)
        return self._noise


def upright(observation: Observation, intention: Array) -> np.ndarray:
    """Action (7,), float32, of an intention (1, 4), with the rotation that keeps the hand down and straight."""
    hand = Rotation.from_quat(observation[AGENT_POS][3:7]).as_matrix()
    tilt = np.cross(hand[:, 2], [0.0, 0.0, -1.0])
    turn = -np.arctan2(hand[1, 0], hand[0, 0])
    ((*displacement, gripper),) = intention
    rotation = ROTATION_GAIN * (tilt + [0.0, 0.0, turn])
    return np.clip([*displacement, *rotation, gripper], -1.0, 1.0).astype(np.float32)


def lift(task: str, way: int, rng: np.random.Generator) -> Expert:
    """Expert that lifts one cube of a key of `lift_tasks.TASKS` in one episode."""
    return Expert(CubeLifter(task, way, rng), act=upright)


EXPERTS: dict[str, WaysExpert] = {
    name: WaysExpert(name, spec.n_ways, partial(lift, name)) for name, spec in TASKS.items()
}
