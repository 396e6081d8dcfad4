"""The tasks of Gymnasium-Robotics that `--env.type=gymnasium_robotics` has, as a table.

A new task is one more entry in `TASKS` (which numbers of its observation belong to the robot and which to the scene,
and what success means) and in `gymnasium_robotics.Task`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from lerobot_agpd.envs.base import TaskSpec

RawObservation = np.ndarray | dict[str, Any]
Success = Callable[[Any, RawObservation, dict[str, Any]], bool]


@dataclass(frozen=True, kw_only=True)
class RoboticsTask(TaskSpec):
    """Properties of one task; actions lie in [-1, 1].

    Attributes:
        agent: indices into the flat observation that make up `agent_pos`, in order.
        scene: indices that make up `environment_state`.
        goal_dim: length of the desired goal that is appended to them; 0 for a task without one.
        success: of the unwrapped environment, the raw observation and the info of a step or a reset.
    """

    agent: Sequence[int]
    scene: Sequence[int]
    goal_dim: int
    success: Success

    def split(self, observation: RawObservation) -> tuple[np.ndarray, np.ndarray]:
        """Split one observation into `agent_pos` (agent_pos_dim,) and `environment_state` (environment_state_dim,).

        Args:
            observation: flat (D,), or a goal dictionary with `observation` (D,) and `desired_goal` (goal_dim,).
        """
        if not isinstance(observation, dict):
            return observation[self.agent], observation[self.scene]
        flat = observation["observation"]
        goal = observation["desired_goal"] if self.goal_dim else []
        return flat[self.agent], np.concatenate([flat[self.scene], goal])


def _task(
    description: str,
    agent: Sequence[int],
    scene: Sequence[int],
    action_dim: int,
    fps: int,
    episode_length: int,
    success: Success,
    goal_dim: int = 0,
) -> RoboticsTask:
    return RoboticsTask(
        description=description,
        fps=fps,
        episode_length=episode_length,
        action_dim=action_dim,
        agent_pos_dim=len(agent),
        environment_state_dim=len(scene) + goal_dim,
        agent=list(agent),
        scene=list(scene),
        goal_dim=goal_dim,
        success=success,
    )


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


def _fetch(description: str, has_object: bool = True) -> RoboticsTask:
    """Grip position (3), finger displacements (2), grip velocity (3), finger velocities (2) are the arm's.

    With an object, its position (3:6), position from the grip (6:9), rotation (11:14), velocity from the grip (14:17)
    and angular velocity (17:20) lie between them.
    """
    agent = [0, 1, 2, 9, 10, 20, 21, 22, 23, 24] if has_object else range(10)
    scene = [*range(3, 9), *range(11, 20)] if has_object else []
    return _task(description, agent, scene, 4, fps=25, episode_length=50, success=_goal_reached, goal_dim=3)


def _adroit(description: str, agent: Sequence[int], dim: int, action_dim: int) -> RoboticsTask:
    """Of an observation (dim,), all that is not the hand's belongs to the scene."""
    scene = sorted(set(range(dim)) - set(agent))
    return _task(description, agent, scene, action_dim, fps=100, episode_length=200, success=_adroit_success)


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

TASKS: dict[str, RoboticsTask] = {
    "FetchReach-v4": _fetch("Move the gripper to the target position.", has_object=False),
    "FetchPush-v4": _fetch("Push the block to the target position on the table."),
    "FetchPickAndPlace-v4": _fetch("Pick up the block and bring it to the target position."),
    "FetchSlide-v4": _fetch("Hit the puck so that it slides to the target position."),
    # Arm, wrist and finger joints, and the position of the palm where it is observed; relocate observes the palm
    # only from the ball and from the target.
    "AdroitHandDoor-v1": _adroit(
        "Undo the latch and swing the door open.", [*range(27), *range(29, 32)], dim=39, action_dim=28
    ),
    "AdroitHandHammer-v1": _adroit(
        "Pick up the hammer and drive the nail into the board.",
        [*range(26), *range(33, 36)],
        dim=46,
        action_dim=26,
    ),
    "AdroitHandPen-v1": _adroit(
        "Turn the pen in the hand to the target orientation.", range(24), dim=45, action_dim=24
    ),
    "AdroitHandRelocate-v1": _adroit(
        "Pick up the ball and move it to the target position.", range(30), dim=39, action_dim=30
    ),
    # Joint positions (9) and velocities (9); then positions (21) and velocities (20) of everything that moves. The
    # goal is the same in every episode and left out: as a constant it would say nothing. 12.5 steps per second.
    KITCHEN: _task(
        "Complete the kitchen tasks.",
        range(18),
        range(18, 59),
        action_dim=9,
        fps=12,
        episode_length=280,
        success=_all_tasks_done,
    ),
}
