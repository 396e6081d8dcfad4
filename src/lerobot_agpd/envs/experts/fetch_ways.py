"""Scripted experts for the tasks of `envs.fetch_ways_tasks`: draw a way, then do as the experts for Fetch do.

Which way an episode takes no observation shows at its start: the demonstrations know several.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from lerobot_agpd.envs.experts.base import Array, Expert, Observation, state_vectors
from lerobot_agpd.envs.experts.fetch import FetchScene, move, pick_and_place, push
from lerobot_agpd.envs.experts.ways import CorrelatedNoise, WaysExpert
from lerobot_agpd.envs.fetch_ways_tasks import TASKS, FetchWaysTask

# Standard deviation of the noise on the motion, action units, and its correlation from one step to the next.
NOISE = 0.02
NOISE_CORRELATION = 0.8
# Distance from the block at which the hand goes round it, and at which the next waypoint takes over, meters.
DETOUR = 0.10
WAYPOINT_RADIUS = 0.012
# Height above the block per distance from it, and the distance at which the hand is down, meters.
SLOPE = 2.1
LINE_END = 0.005
# How far above itself a hand that lifts a block aims, meters.
LIFT_STRIDE = 0.05

type Intend = Callable[[Observation], np.ndarray]


def _at_most(displacement: Array, length: float) -> Array:
    """Shorten a displacement (3,) to a length."""
    return displacement * min(1.0, length / max(float(np.linalg.norm(displacement)), 1e-6))


def reach_place(task: FetchWaysTask, place: int, observation: Observation) -> np.ndarray:
    """Go straight to a place; action (4,)."""
    _, vectors = state_vectors(observation, task.agent_pos_dim, task.environment_state_dim)
    return move(_at_most(vectors.reshape(-1, 3)[place], task.stride), gripper=0.0)


def pick_block(task: FetchWaysTask, block: int, observation: Observation) -> np.ndarray:
    """Come down onto a block on a straight steep line, grasp it and lift it; action (4,).

    The line is steep enough for open fingers to pass the block's edges, and all lines begin where the hand starts: it
    comes down whatever the block is.
    """
    agent_pos, state = state_vectors(observation, task.agent_pos_dim, task.environment_state_dim)
    position = state.reshape(2, -1, 3)[0, block]
    to_block = position - agent_pos[:3]
    distance = float(np.linalg.norm(to_block[:2]))
    stride = min(task.stride, distance)
    across = to_block[:2] * stride / max(distance, 1e-6)
    height = SLOPE * max(distance - stride - LINE_END, 0.0)
    scene = FetchScene(
        grip=agent_pos[:3],
        width=float(agent_pos[3] + agent_pos[4]),
        block=position,
        goal=position + np.array([0.0, 0.0, LIFT_STRIDE]),
    )
    return pick_and_place(scene, approach=np.append(across, to_block[2] + height))


class PushFromSide:
    """Goes round the block to one side, to the far side of it from the place, and pushes."""

    def __init__(self, task: FetchWaysTask, side: int) -> None:
        """Begin an episode; `side` is the task's way."""
        sign = 1.0 if side == 0 else -1.0
        self._task = task
        self._corners = [(0.03, sign * DETOUR), (-0.07, sign * DETOUR), (-0.07, 0.0)]  # from the block
        self._next = 0

    def __call__(self, observation: Observation) -> np.ndarray:
        """Action (4,)."""
        scene = FetchScene.from_observation(observation)
        while self._next < len(self._corners):
            displacement = scene.block + np.array([*self._corners[self._next], 0.0]) - scene.grip
            if np.linalg.norm(displacement[:2]) > WAYPOINT_RADIUS:
                return move(_at_most(displacement, self._task.stride), gripper=0.0)
            self._next += 1
        return push(scene)


def follow(task: str, way: int, rng: np.random.Generator) -> Expert:
    """Expert that takes a way of a key of `fetch_ways_tasks.TASKS` for one episode."""
    spec = TASKS[task]
    ways: dict[str, Intend] = {
        "reach": partial(reach_place, spec, way),
        "pick_and_place": partial(pick_block, spec, way),
        "push": PushFromSide(spec, way),
    }
    intend, noise = ways[spec.model], CorrelatedNoise(NOISE, NOISE_CORRELATION, 3, rng)
    return Expert(lambda observation: intend(observation) + np.append(noise(), 0.0))


EXPERTS: dict[str, WaysExpert] = {
    name: WaysExpert(name, spec.n_ways, partial(follow, name)) for name, spec in TASKS.items()
}
