"""Manipulation with Fetch that can be done in several ways, the tasks of `--env.type=fetch_ways`.

Positions are meters in Fetch's world: x leads away from the robot, y to its left, the table's top is at z = 0.4. Nothing
here needs a simulator.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lerobot_agpd.envs.robotics_tasks import (
    ARM,
    ARM_AND_OBJECT,
    RawObservation,
    RoboticsTask,
    Success,
    goal_reached,
)
from lerobot_agpd.envs.ways import Array, WaysTask

Point = tuple[float, float, float]

PLACE_RADIUS = 0.05
"""Distance from a place at which it counts as reached, Fetch's."""


@dataclass(frozen=True, kw_only=True)
class FetchWaysTask(RoboticsTask, WaysTask):
    """A task of Fetch with several ways: bring a block, or without one the gripper, to a place.

    Attributes:
        model: Fetch's model; the fingers move in `pick_and_place` only.
        hand_height: Fetch's `gripper_extra_height`: above the table by so much and a little more the hand starts.
        blocks: where the blocks start, of which any may be brought.
        places: of which any is the goal.
        slope: of the expert's way down to a block or a place, height per distance.
        stride: how far ahead of itself the expert aims at most on its way; this bounds its speed.
    """

    model: Literal["reach", "push", "pick_and_place"]
    hand_height: float
    blocks: tuple[Point, ...] = ()
    places: tuple[Point, ...]
    stride: float
    slope: float = 0.0
    fps: int = 25
    action_dim: int = 4
    agent_pos_dim: int = 10
    success: Success = goal_reached


@dataclass(frozen=True, kw_only=True)
class AnyPlaceTask(FetchWaysTask):
    """Bring the block, or without one the gripper, to a place: every place is a way.

    `environment_state` is that of the task with one goal, and in the place of the goal the vectors to all places.
    """

    def split(self, observation: RawObservation) -> tuple[np.ndarray, np.ndarray]:
        """Split one observation; see `RoboticsTask.split`."""
        assert isinstance(observation, dict)
        agent_pos, environment_state = super().split(observation)
        environment_state[-self.goal_dim :] -= np.tile(observation["achieved_goal"], len(self.places))
        return agent_pos, environment_state

    @property
    def n_ways(self) -> int:
        """Number of places."""
        return len(self.places)

    def way_of(self, agent_pos: Array, environment_state: Array) -> int:
        """Place that was nearest at the end; see `WaysTask.way_of`."""
        return int(np.linalg.norm(self.vectors(environment_state[-1]), axis=1).argmin())

    def vectors(self, environment_state: Array) -> Array:
        """Vectors (N, 3) to the places, of an `environment_state` (environment_state_dim,)."""
        return environment_state[-self.goal_dim :].reshape(-1, 3)


@dataclass(frozen=True, kw_only=True)
class AnyBlockTask(FetchWaysTask):
    """Lift a block: every block is a way. `environment_state`: positions of all blocks, then from the gripper."""

    def split(self, observation: RawObservation) -> tuple[np.ndarray, np.ndarray]:
        """Split one observation; see `RoboticsTask.split`."""
        assert isinstance(observation, dict)
        agent_pos, _ = super().split(observation)
        blocks = observation["achieved_goal"]
        return agent_pos, np.concatenate([blocks, blocks - np.tile(agent_pos[:3], len(self.blocks))])

    @property
    def n_ways(self) -> int:
        """Number of blocks."""
        return len(self.blocks)

    def way_of(self, agent_pos: Array, environment_state: Array) -> int:
        """Block that was highest at the end; see `WaysTask.way_of`."""
        return int(environment_state[-1, 2 : 3 * self.n_ways : 3].argmax())


@dataclass(frozen=True, kw_only=True)
class EitherSideTask(FetchWaysTask):
    """Go round the block to push it to a place: way 0 on its left, where y grows, 1 on its right.

    `environment_state` is FetchPush's.
    """

    @property
    def n_ways(self) -> int:
        """Two sides."""
        return 2

    def way_of(self, agent_pos: Array, environment_state: Array) -> int:
        """Side on which the hand was farthest from the block; see `WaysTask.way_of`."""
        sideways = agent_pos[:, 1] - environment_state[:, 1]  # y of the hand and of the block
        return int(sideways[np.abs(sideways).argmax()] < 0)


def _around(radius: float, height: float) -> tuple[Point, Point, Point]:
    """Three points at one distance from where the hand starts, so that no way begins earlier than another.

    One lies ahead, two behind it on the left and right. Their coordinate-wise median lies between the last two.
    """
    x, y = 1.342, 0.749
    back = 0.58 * radius
    side = math.sqrt(radius**2 - back**2)
    return (x + radius, y, height), (x - back, y + side, height), (x - back, y - side, height)


TASKS: dict[str, FetchWaysTask] = {
    "ReachAnyPlace-v0": AnyPlaceTask(
        description="Move the gripper to any of the places.",
        model="reach",
        hand_height=0.2,
        places=_around(0.18, height=0.425),
        agent=ARM[0],
        scene=ARM[1],
        environment_state_dim=9,
        goal_dim=9,
        # No time for a second try, as in PickAndPlaceAnyPlace.
        episode_length=14,
        stride=0.05,
    ),
    "PickAnyBlock-v0": AnyBlockTask(
        description="Pick up any of the blocks.",
        model="pick_and_place",
        hand_height=0.29,
        blocks=_around(0.12, height=0.425),
        places=_around(0.12, height=0.525),
        agent=ARM_AND_OBJECT[0],
        scene=(),
        environment_state_dim=18,
        episode_length=40,
        stride=0.03,
        slope=2.1,
    ),
    "PickAndPlaceAnyPlace-v0": AnyPlaceTask(
        description="Pick up the block and bring it to any of the places.",
        model="pick_and_place",
        hand_height=0.2,
        blocks=((1.342, 0.749, 0.425),),
        places=_around(0.16, height=0.425),
        agent=ARM_AND_OBJECT[0],
        scene=ARM_AND_OBJECT[1],
        environment_state_dim=24,
        goal_dim=9,
        # No time for a second try: with 45 steps a student that comes down between the places drifts to one of them.
        episode_length=32,
        stride=0.05,
        slope=1.3,
    ),
    "PushEitherSide-v0": EitherSideTask(
        description="Go round the block and push it to the place.",
        model="push",
        hand_height=0.0,
        blocks=((1.23, 0.75, 0.425),),
        places=((1.40, 0.75, 0.425),),
        agent=ARM_AND_OBJECT[0],
        scene=ARM_AND_OBJECT[1],
        environment_state_dim=18,
        goal_dim=3,
        episode_length=60,
        stride=0.06,
    ),
}
"""`--env.task` to task."""
