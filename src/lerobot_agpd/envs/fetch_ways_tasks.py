"""Manipulation with Fetch that can be done in several ways, the tasks of `--env.type=fetch_ways`.

Positions are meters in Fetch's world: x leads away from the robot, y to its left, the table's top is at z = 0.4. Nothing
here needs a simulator.
"""

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


@dataclass(frozen=True)
class Wall:
    """A box on the table.

    Attributes:
        center: of the box.
        half_size: half its extent in x, y and z.
    """

    center: Point
    half_size: Point


@dataclass(frozen=True, kw_only=True)
class FetchWaysTask(RoboticsTask, WaysTask):
    """A task of Fetch with several ways; `environment_state` ends with the vectors to all places.

    The vectors lead from what shall be brought to a place, the block or without one the gripper.

    Attributes:
        model: Fetch's model, which also says where the hand starts and whether its fingers move.
        places: of which any is the goal.
        block: where the block starts; None for a task without one.
        walls: obstacles on the table.
        stride: how far ahead of itself the expert aims at most on its way; this bounds its speed.
    """

    model: Literal["reach", "push", "pick_and_place"]
    places: tuple[Point, ...]
    block: Point | None
    walls: tuple[Wall, ...] = ()
    stride: float
    fps: int = 25
    action_dim: int = 4
    agent_pos_dim: int = 10
    success: Success = goal_reached

    def split(self, observation: RawObservation) -> tuple[np.ndarray, np.ndarray]:
        """Split one observation; the places become vectors. See `RoboticsTask.split`."""
        assert isinstance(observation, dict)
        agent_pos, environment_state = super().split(observation)
        brought = np.tile(observation["achieved_goal"], len(self.places))
        environment_state[-len(brought) :] -= brought
        return agent_pos, environment_state

    def vectors(self, environment_state: Array) -> Array:
        """Vectors (..., N, 3) to the N places, of an `environment_state` (..., environment_state_dim)."""
        last = environment_state[..., -3 * len(self.places) :]
        return last.reshape(*last.shape[:-1], len(self.places), 3)


@dataclass(frozen=True, kw_only=True)
class AnyPlaceTask(FetchWaysTask):
    """A task whose ways are its places."""

    @property
    def n_ways(self) -> int:
        """Number of places."""
        return len(self.places)

    def way_of(self, agent_pos: Array, environment_state: Array) -> int:
        """Place that was nearest at the end; see `WaysTask.way_of`."""
        return int(np.linalg.norm(self.vectors(environment_state[-1]), axis=-1).argmin())


@dataclass(frozen=True, kw_only=True)
class EitherSideTask(FetchWaysTask):
    """A task with one place and two ways round the block: 0 with the hand on its left (y above the block's), 1 right."""

    @property
    def n_ways(self) -> int:
        """Two sides."""
        return 2

    def way_of(self, agent_pos: Array, environment_state: Array) -> int:
        """Side on which the hand was farthest from the block; see `WaysTask.way_of`."""
        sideways = agent_pos[:, 1] - environment_state[:, 1]  # y of the hand and of the block
        return int(sideways[np.abs(sideways).argmax()] < 0)


# Where the block of PickAndPlaceAnyPlace starts, and how far to each side of it the dead end has its walls.
_BLOCK: Point = (1.32, 0.75, 0.425)
_HALF_WIDTH = 0.06
_WALL = 0.01  # half the thickness
_TOP = 0.05  # half the height


def _dead_end(mouth: float, back: float) -> tuple[Wall, ...]:
    """Three walls around a strip of the table toward the robot, open to the block.

    Args:
        mouth: x at which the strip begins.
        back: x of the wall that closes it.
    """
    x, y, z = 0.5 * (mouth + back), _BLOCK[1], 0.4 + _TOP
    side = (0.5 * (mouth - back), _WALL, _TOP)
    return (
        Wall((x, y + _HALF_WIDTH, z), side),
        Wall((x, y - _HALF_WIDTH, z), side),
        Wall((back, y, z), (_WALL, _HALF_WIDTH + _WALL, _TOP)),
    )


TASKS: dict[str, FetchWaysTask] = {
    "ReachAnyPlace-v0": AnyPlaceTask(
        description="Move the gripper to any of the places.",
        model="reach",
        agent=ARM[0],
        scene=ARM[1],
        environment_state_dim=9,
        goal_dim=9,
        places=((1.49, 0.75, 0.535), (1.34, 0.9, 0.535), (1.34, 0.75, 0.685)),
        block=None,
        episode_length=30,
        stride=0.1,
    ),
    "PickAndPlaceAnyPlace-v0": AnyPlaceTask(
        description="Pick up the block and bring it to any of the places.",
        model="pick_and_place",
        agent=ARM_AND_OBJECT[0],
        scene=ARM_AND_OBJECT[1],
        environment_state_dim=24,
        goal_dim=9,
        places=((1.50, 0.75, 0.445), (1.22, 0.95, 0.445), (1.22, 0.55, 0.445)),
        block=_BLOCK,
        walls=_dead_end(mouth=1.235, back=1.07),
        episode_length=60,
        stride=0.03,
    ),
    "PushEitherSide-v0": EitherSideTask(
        description="Go round the block and push it to the place.",
        model="push",
        agent=ARM_AND_OBJECT[0],
        scene=ARM_AND_OBJECT[1],
        environment_state_dim=18,
        goal_dim=3,
        places=((1.40, 0.75, 0.425),),
        block=(1.23, 0.75, 0.425),
        episode_length=60,
        stride=0.06,
    ),
}
"""`--env.task` to task."""
