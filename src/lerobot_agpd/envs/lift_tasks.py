"""Robot manipulation that can be done in several ways, the tasks of `--env.type=robosuite_ways`.

A Panda stands before cubes on a table and lifts any of them. Nothing here needs a simulator.
"""

from dataclasses import dataclass
from typing import Any

from lerobot_agpd.envs.robomimic_tasks import ARM_ACTION_DIM, ARM_CONTROLLER
from lerobot_agpd.envs.ways import Array, WaysTask

FPS = 20
"""Control steps per second."""

SPEED = 2
"""How much farther than in robomimic's tasks an action moves the hand, so that eight of them decide where it goes."""

_LIMITS = [SPEED * limit for limit in ARM_CONTROLLER["output_max"][:3]] + ARM_CONTROLLER["output_max"][3:]
CONTROLLER: dict[str, Any] = {
    **ARM_CONTROLLER,
    "output_max": _LIMITS,
    "output_min": [-limit for limit in _LIMITS],
}
"""The arm's controller: robomimic's, and faster. Actions are those of `robomimic_tasks.ARM_ACTION_DIM`."""

POSTURE = (0.0, 0.48756, 0.0, -2.17213, 0.0, 2.65969, 0.785398)
"""Joints (radians) at the start: the hand points down from 18 cm above the table's center."""

TABLE_HEIGHT = 0.8  # meters
HALF_CUBE = 0.02  # meters
LIFTED = 0.04
"""Height of a cube's center above the table at which it counts as lifted, meters; robosuite's."""


@dataclass(frozen=True, kw_only=True)
class LiftTask(WaysTask):
    """Cubes on a table of which any is to be lifted; `environment_state` holds the vectors from the hand to all cubes.

    Attributes:
        cubes: places x, y of the cubes, meters, world frame.
    """

    cubes: tuple[tuple[float, float], ...]
    fps: int = FPS
    action_dim: int = ARM_ACTION_DIM
    agent_pos_dim: int = 9

    @property
    def n_ways(self) -> int:
        """Number of cubes."""
        return len(self.cubes)

    def way_of(self, agent_pos: Array, environment_state: Array) -> int:
        """Cube that is highest at the end; see `WaysTask.way_of`."""
        return int(environment_state[-1].reshape(-1, 3)[:, 2].argmax())


TASKS: dict[str, LiftTask] = {
    "LiftAny-v0": LiftTask(
        description="Lift any cube.",
        cubes=((0.12, 0.0), (-0.06, 0.104), (-0.06, -0.104)),
        environment_state_dim=9,
        episode_length=40,
    ),
}
"""`--env.task` to task."""
