"""Mazes that can be solved in several ways, the tasks of `--env.type=point_maze_ways`.

A task is a map in PointMaze's cells of one meter and a list of choices. Every option of a choice is a short list of
waypoints; a way takes one option of every choice, so a task has the product of their numbers. Nothing here needs a
simulator.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lerobot_agpd.envs.ways import Array, WaysTask

Points = tuple[tuple[float, float], ...]

FPS = 10
"""Control steps per second: ten of PointMaze's steps of 10 ms each. A chunk of eight actions then lasts long enough
to decide which way the ball goes."""

WALL, START, EXIT = "#", "r", "g"
"""Cells of a map; every other cell is free."""


@dataclass(frozen=True, kw_only=True)
class MazeTask(WaysTask):
    """A maze with several ways through it; `environment_state` holds the vectors from the ball to all exits.

    Attributes:
        maze: rows of the map, north first, one character per cell: `WALL`, `START`, `EXIT` or free.
        choices: for every choice the waypoints of each option, meters, the map's center being the origin.
        speed: of the expert, m/s.
    """

    description: str
    maze: tuple[str, ...]
    choices: tuple[tuple[Points, ...], ...]
    speed: float
    fps: int = FPS
    agent_pos_dim: int = 4
    action_dim: int = 2

    def _centers(self, cell: str) -> Array:
        """Centers (N, 2) of the cells of a kind, in reading order; PointMaze has the same coordinates."""
        height, width = len(self.maze), len(self.maze[0])
        found = [(i, j) for i, row in enumerate(self.maze) for j, kind in enumerate(row) if kind == cell]
        return np.array([(j + 0.5 - width / 2, height / 2 - i - 0.5) for i, j in found])

    @cached_property
    def start(self) -> Array:
        """Center (2,) of the cell in which episodes begin."""
        return self._centers(START)[0]

    @cached_property
    def exits(self) -> Array:
        """Centers (N, 2) of the cells of which any is the goal."""
        return self._centers(EXIT)

    @property
    def n_ways(self) -> int:
        """Number of ways."""
        return math.prod(len(options) for options in self.choices)

    def options_of(self, way: int) -> tuple[int, ...]:
        """Option of every choice that a way takes; the first choice counts most."""
        return tuple(int(index) for index in np.unravel_index(way, [len(choice) for choice in self.choices]))

    def waypoints(self, way: int) -> Array:
        """Waypoints (N, 2) of a way, the exit nearest to the last option at the end."""
        chosen = zip(self.choices, self.options_of(way), strict=True)
        points = [point for options, index in chosen for point in options[index]]
        distances = np.linalg.norm(self.exits - np.array(points[-1]), axis=1)
        return np.array([*points, self.exits[distances.argmin()]])

    def way_of(self, agent_pos: Array, environment_state: Array) -> int:
        """Of every choice the option whose waypoints the ball came nearest to; see `WaysTask.way_of`."""
        indices = [
            int(np.argmin([_mean_distance(agent_pos[:, :2], option) for option in options]))
            for options in self.choices
        ]
        return int(np.ravel_multi_index(indices, [len(options) for options in self.choices]))


def _mean_distance(positions: Array, waypoints: Points) -> float:
    """Mean over waypoints of the distance at which a path (T, 2) passes them."""
    offsets = np.asarray(positions)[:, None] - np.array(waypoints)  # (T, N, 2)
    return float(np.linalg.norm(offsets, axis=-1).min(axis=0).mean())


def _round_by(x: float) -> tuple[Points, Points]:
    """Past an obstacle of one cell at (x, 0) on its north or south side, eastward."""
    return ((x - 0.5, 1.0), (x + 0.5, 1.0)), ((x - 0.5, -1.0), (x + 0.5, -1.0))


TASKS: dict[str, MazeTask] = {
    "TwoWays-v0": MazeTask(
        description="Go round the obstacle to the goal.",
        maze=(
            "#######",
            "#..g..#",
            "#.....#",
            "#.###.#",
            "#.....#",
            "#..r..#",
            "#######",
        ),
        choices=((((-2.0, -0.5), (-2.0, 0.5)), ((2.0, -0.5), (2.0, 0.5))),),
        environment_state_dim=2,
        episode_length=100,
        speed=1.3,
    ),
    "ThreeExits-v0": MazeTask(
        description="Leave the room through any exit.",
        maze=(
            "###g###",
            "###.###",
            "###.###",
            "###.###",
            "###.###",
            "###.###",
            "#.....#",
            "#..r..#",
            "#.....#",
            "#.#.#.#",
            "#.#.#.#",
            "#.###.#",
            "#.###.#",
            "#g###g#",
        ),
        choices=((((0.0, 1.1), (0.0, 6.5)), ((-2.0, -2.1), (-2.0, -6.5)), ((2.0, -2.1), (2.0, -6.5))),),
        environment_state_dim=6,
        episode_length=80,
        speed=2.5,
    ),
    "Chain-v0": MazeTask(
        description="Pass the three obstacles and reach the goal.",
        maze=(
            "#############",
            "#...........#",
            "#r.#..#..#.g#",
            "#...........#",
            "#############",
        ),
        choices=(_round_by(-3.0), _round_by(0.0), _round_by(3.0)),
        environment_state_dim=2,
        episode_length=130,
        speed=2.0,
    ),
}
"""`--env.task` to task."""
