"""Scripted experts for the mazes of `envs.maze_tasks`: draw a way, then follow its waypoints.

Which way an episode takes no observation shows at its start: the demonstrations know several.
"""

from functools import partial

import numpy as np

from lerobot_agpd.envs.base import AGENT_POS
from lerobot_agpd.envs.experts.base import Array, Expert, Observation
from lerobot_agpd.envs.experts.ways import CorrelatedNoise, WaysExpert
from lerobot_agpd.envs.maze_tasks import TASKS

# Acceleration at an action of 1 of PointMaze's ball of 4.19 kg with a gear of 100, m/s^2.
ACCELERATION = 23.9
# Seconds in which the controller makes up for a difference in velocity.
VELOCITY_TIME = 0.15
# Distance at which the next waypoint takes over, meters.
WAYPOINT_RADIUS = 0.4
# Standard deviation of the force's noise, action units, and its correlation from one step to the next.
NOISE = 0.02
NOISE_CORRELATION = 0.8


class WayFollower:
    """Follows one way for one episode."""

    def __init__(self, waypoints: Array, speed: float, rng: np.random.Generator) -> None:
        """Begin an episode.

        Args:
            waypoints: (N, 2), meters.
            speed: m/s.
            rng: source of the noise.
        """
        self._waypoints = waypoints
        self._speed = speed
        self._next = 0
        self._noise = CorrelatedNoise(NOISE, NOISE_CORRELATION, 2, rng)

    def __call__(self, observation: Observation) -> Array:
        """Intention (4,): force in x and y, and two zeros."""
        state = np.asarray(observation[AGENT_POS], dtype=np.float64)
        if state.shape != (4,):
            raise ValueError(f"Expected {AGENT_POS} (4,) of a single environment, got {state.shape}.")
        position, velocity = state[:2], state[2:]
        last = len(self._waypoints) - 1
        while self._next < last and self._distance(position) < WAYPOINT_RADIUS:
            self._next += 1
        heading = (self._waypoints[self._next] - position) / max(self._distance(position), 1e-6)
        force = (self._speed * heading - velocity) / (VELOCITY_TIME * ACCELERATION)
        return np.append(force + self._noise(), np.zeros(2))

    def _distance(self, position: Array) -> float:
        return float(np.linalg.norm(self._waypoints[self._next] - position))


def ball_position(observation: Observation) -> Array:
    """Position (1, 3) of the ball, meters."""
    return np.append(np.asarray(observation[AGENT_POS][:2], dtype=np.float64), 0.0)[None]


def as_force(observation: Observation, intention: Array) -> np.ndarray:
    """Action (2,), float32, of an intention (1, 4)."""
    return np.clip(intention[0, :2], -1.0, 1.0).astype(np.float32)


def follow(task: str, way: int, rng: np.random.Generator) -> Expert:
    """Expert that takes a way of a key of `maze_tasks.TASKS` for one episode."""
    spec = TASKS[task]
    return Expert(WayFollower(spec.waypoints(way), spec.speed, rng), ball_position, as_force)


EXPERTS: dict[str, WaysExpert] = {
    name: WaysExpert(name, spec.n_ways, partial(follow, name)) for name, spec in TASKS.items()
}
