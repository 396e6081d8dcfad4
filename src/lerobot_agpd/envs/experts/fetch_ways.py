"""Scripted experts for the tasks of `envs.fetch_ways_tasks`: draw a way, then do as the experts for Fetch do.

Which way an episode takes no observation shows at its start: the demonstrations know several.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from lerobot_agpd.envs.experts.base import Array, Expert, Observation, ramp, state_vectors
from lerobot_agpd.envs.experts.fetch import FetchScene, move, pick_and_place, push
from lerobot_agpd.envs.experts.ways import CorrelatedNoise, WaysExpert
from lerobot_agpd.envs.fetch_ways_tasks import TASKS, AnyBlockTask, AnyPlaceTask, FetchWaysTask

# Standard deviation of the noise on the motion, action units, and its correlation from one step to the next.
NOISE = 0.02
NOISE_CORRELATION = 0.8
# Distance from the block at which the hand goes round it, and at which the next waypoint takes over, meters.
DETOUR = 0.10
WAYPOINT_RADIUS = 0.012
# Distance from the end of the way down at which the hand is down, meters.
LINE_END = 0.005
# How far above itself a hand that lifts a block aims, meters.
LIFT_STRIDE = 0.05

type Intend = Callable[[Observation], np.ndarray]


def _at_most(displacement: Array, length: float) -> Array:
    """Shorten a displacement (3,) to a length."""
    return displacement * min(1.0, length / max(float(np.linalg.norm(displacement)), 1e-6))


def _down_the_line(displacement: Array, task: FetchWaysTask) -> Array:
    """Displacement (3,) that comes down a steep straight line, which ends at a given one.

    All lines to points at the same distance begin at the same height: above the middle of three points the hand comes
    down whichever it goes to. The hand rises to the line before it moves across.
    """
    distance = float(np.linalg.norm(displacement[:2]))
    below = task.slope * max(distance - LINE_END, 0.0) + displacement[2]
    across = ramp(below, zero_at=0.05, one_at=0.01) * min(task.stride, distance)
    height = task.slope * max(distance - across - LINE_END, 0.0)
    return np.append(displacement[:2] * across / max(distance, 1e-6), displacement[2] + height)


def reach_place(task: AnyPlaceTask, place: int, observation: Observation) -> np.ndarray:
    """Go straight to a place; action (4,)."""
    _, vectors = state_vectors(observation, task.agent_pos_dim, task.environment_state_dim)
    return move(_at_most(task.vectors(vectors)[place], task.stride), gripper=0.0)


def place_block(task: AnyPlaceTask, place: int, observation: Observation) -> np.ndarray:
    """Grasp the block, lift it and bring it down to a place; action (4,)."""
    agent_pos, state = state_vectors(observation, task.agent_pos_dim, task.environment_state_dim)
    carry = _down_the_line(task.vectors(state)[place], task)
    scene = FetchScene(agent_pos[:3], float(agent_pos[3] + agent_pos[4]), state[:3], state[:3] + carry)
    return pick_and_place(scene)


def pick_block(task: AnyBlockTask, block: int, observation: Observation) -> np.ndarray:
    """Come down onto a block with open fingers, grasp it and lift it; action (4,)."""
    agent_pos, state = state_vectors(observation, task.agent_pos_dim, task.environment_state_dim)
    position = state.reshape(2, -1, 3)[0, block]
    goal = position + np.array([0.0, 0.0, LIFT_STRIDE])
    scene = FetchScene(agent_pos[:3], float(agent_pos[3] + agent_pos[4]), position, goal)
    return pick_and_place(scene, approach=_down_the_line(position - agent_pos[:3], task))


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
    intend: Intend
    if isinstance(spec, AnyPlaceTask):
        intend = partial(place_block if spec.blocks else reach_place, spec, way)
    elif isinstance(spec, AnyBlockTask):
        intend = partial(pick_block, spec, way)
    else:
        intend = PushFromSide(spec, way)
    noise = CorrelatedNoise(NOISE, NOISE_CORRELATION, 3, rng)
    return Expert(lambda observation: intend(observation) + np.append(noise(), 0.0))


EXPERTS: dict[str, WaysExpert] = {
    name: WaysExpert(name, spec.n_ways, partial(follow, name)) for name, spec in TASKS.items()
}
