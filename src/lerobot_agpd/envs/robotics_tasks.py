"""The tasks of Gymnasium-Robotics that `--env.type=gymnasium_robotics` has, as a table.

A new task is one more entry in `TASKS` (which numbers of its observation belong to the robot and which to the scene,
and what success means) and in `gymnasium_robotics.Task`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS

RawObservation = np.ndarray | dict[str, Any]
Success = Callable[[Any, RawObservation, dict[str, Any]], bool]

OBSERVED_KEYS: dict[str, tuple[str, ...]] = {
    "state": (AGENT_POS, ENVIRONMENT_STATE),
    "pixels": (PIXELS,),
    "pixels_agent_pos": (AGENT_POS, PIXELS),
}
"""Raw keys of every `--env.obs_type`."""


@dataclass(frozen=True)
class ObservationLayout:
    """Where the entries of a flat observation go.

    Attributes:
        agent_pos: indices into the flat observation that make up `agent_pos`, in order.
        environment_state: indices that make up `environment_state`.
        goal_dim: length of the desired goal that is appended to them; 0 for a task without one.
    """

    agent_pos: tuple[int, ...]
    environment_state: tuple[int, ...]
    goal_dim: int = 0

    @property
    def agent_pos_dim(self) -> int:
        """Length of `agent_pos`."""
        return len(self.agent_pos)

    @property
    def environment_state_dim(self) -> int:
        """Length of `environment_state`, the desired goal included."""
        return len(self.environment_state) + self.goal_dim

    def split(self, observation: RawObservation) -> dict[str, np.ndarray]:
        """Turn one observation into LeRobot's raw keys.

        Args:
            observation: flat (D,), or a goal dictionary with `observation` (D,) and `desired_goal` (goal_dim,).

        Returns:
            `agent_pos` (agent_pos_dim,) and `environment_state` (environment_state_dim,), both float32.
        """
        flat = observation["observation"] if isinstance(observation, dict) else observation
        scene = flat[list(self.environment_state)]
        if self.goal_dim:
            assert isinstance(observation, dict)
            scene = np.concatenate([scene, observation["desired_goal"]])
        return {
            AGENT_POS: flat[list(self.agent_pos)].astype(np.float32),
            ENVIRONMENT_STATE: scene.astype(np.float32),
        }


@dataclass(frozen=True)
class TaskSpec:
    """Properties of one task.

    Attributes:
        description: one sentence, LeRobot's `task_description`.
        layout: how its observation is split.
        action_dim: length of an action; actions lie in [-1, 1].
        fps: control steps per second of simulated time, rounded down.
        episode_length: Gymnasium-Robotics' own limit in steps.
        success: of the unwrapped environment, the raw observation and the info of a step or a reset.
    """

    description: str
    layout: ObservationLayout
    action_dim: int
    fps: int
    episode_length: int
    success: Success


def _goal_reached(env: Any, observation: RawObservation, info: dict[str, Any]) -> bool:
    """Fetch: the achieved goal lies within 5 cm of the desired one. Can be told after a reset, too."""
    assert isinstance(observation, dict)
    return bool(env._is_success(observation["achieved_goal"], observation["desired_goal"]))


def _adroit_success(env: Any, observation: RawObservation, info: dict[str, Any]) -> bool:
    """Adroit: what the environment says; it says nothing after a reset."""
    return bool(info.get("success", False))


def _all_tasks_done(env: Any, observation: RawObservation, info: dict[str, Any]) -> bool:
    """Kitchen: every task of `tasks_to_complete` has been done at some step of the episode."""
    return set(env.goal) <= set(info["episode_task_completions"])


# Grip position (3), finger displacements (2), grip velocity (3), finger velocities (2): an arm alone has these only.
_FETCH_ARM = ObservationLayout(agent_pos=tuple(range(10)), environment_state=(), goal_dim=3)
# With an object, its position (3:6), position from the grip (6:9), rotation (11:14), velocity from the grip (14:17)
# and angular velocity (17:20) lie between them.
_FETCH_OBJECT = ObservationLayout(
    agent_pos=(0, 1, 2, 9, 10, 20, 21, 22, 23, 24),
    environment_state=(*range(3, 9), *range(11, 20)),
    goal_dim=3,
)


def _fetch(description: str, layout: ObservationLayout) -> TaskSpec:
    return TaskSpec(description, layout, 4, 25, 50, _goal_reached)


def _adroit(
    description: str, agent: tuple[int, ...], dim: int, action_dim: int, episode_length: int = 200
) -> TaskSpec:
    """Of an observation (dim,), all that is not the hand's belongs to the scene."""
    scene = tuple(index for index in range(dim) if index not in agent)
    layout = ObservationLayout(agent_pos=agent, environment_state=scene)
    return TaskSpec(description, layout, action_dim, 100, episode_length, _adroit_success)


TASKS: dict[str, TaskSpec] = {
    "FetchReach-v4": _fetch("Move the gripper to the target position.", _FETCH_ARM),
    "FetchPush-v4": _fetch("Push the block to the target position on the table.", _FETCH_OBJECT),
    "FetchPickAndPlace-v4": _fetch("Pick up the block and bring it to the target position.", _FETCH_OBJECT),
    "FetchSlide-v4": _fetch("Hit the puck so that it slides to the target position.", _FETCH_OBJECT),
    # Arm, wrist and finger joints, and the position of the palm where it is observed; relocate observes the palm
    # only from the ball and from the target.
    "AdroitHandDoor-v1": _adroit(
        "Undo the latch and swing the door open.", (*range(27), *range(29, 32)), dim=39, action_dim=28
    ),
    "AdroitHandHammer-v1": _adroit(
        "Pick up the hammer and drive the nail into the board.",
        (*range(26), *range(33, 36)),
        dim=46,
        action_dim=26,
    ),
    "AdroitHandPen-v1": _adroit(
        "Turn the pen in the hand to the target orientation.", tuple(range(24)), dim=45, action_dim=24
    ),
    "AdroitHandRelocate-v1": _adroit(
        "Pick up the ball and move it to the target position.", tuple(range(30)), dim=39, action_dim=30
    ),
    # Joint positions (9) and velocities (9); then positions (21) and velocities (20) of everything that moves. The
    # goal is the same in every episode and left out: as a constant it would say nothing. 12.5 steps per second.
    "FrankaKitchen-v1": TaskSpec(
        description="Complete the kitchen tasks.",
        layout=ObservationLayout(agent_pos=tuple(range(18)), environment_state=tuple(range(18, 59))),
        action_dim=9,
        fps=12,
        episode_length=280,
        success=_all_tasks_done,
    ),
}

KITCHEN = "FrankaKitchen-v1"
KitchenTask = Literal[
    "bottom burner",
    "top burner",
    "light switch",
    "slide cabinet",
    "hinge cabinet",
    "microwave",
    "kettle",
]
KITCHEN_DEFAULT: tuple[KitchenTask, ...] = ("microwave", "kettle", "light switch", "slide cabinet")
"""The four of D4RL's `kitchen-complete` (arXiv:2004.07219)."""


def get_task(task: str | None) -> TaskSpec:
    """Look a task up in `TASKS`.

    Raises:
        ValueError: if the task is unknown.
    """
    if task not in TASKS:
        raise ValueError(f"--env.task must be one of {', '.join(TASKS)}; got {task!r}.")
    return TASKS[task]
