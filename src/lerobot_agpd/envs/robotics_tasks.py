"""The tasks of Gymnasium-Robotics that `--env.type=gymnasium_robotics` has, as a table.

A new task is one more entry in `TASKS` (which numbers of its observation belong to the robot and which to the scene,
and what success means) and in `gymnasium_robotics.Task`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lerobot_agpd.envs.base import TaskSpec
from lerobot_agpd.envs.poses import FETCH_POSE, FETCH_POSES, SLIDE_POSE, SLIDE_POSES, CameraPose

RawObservation = np.ndarray | dict[str, Any]
Success = Callable[[Any, RawObservation, dict[str, Any]], bool]


@dataclass(frozen=True, kw_only=True)
class RoboticsTask(TaskSpec):
    """Properties of one task; actions lie in [-1, 1].

    Attributes:
        agent: indices into the flat observation that make up `agent_pos`, in order.
        scene: indices that make up `environment_state`.
        success: of the unwrapped environment, the raw observation and the info of a step or a reset.
        goal_dim: length of the desired goal that is appended to `environment_state`; 0 for a task without one.
        pose: of the main camera; None: the one that the environment renders with.
        poses: of the named cameras.
    """

    agent: Sequence[int]
    scene: Sequence[int]
    success: Success
    goal_dim: int = 0
    pose: CameraPose | None = None
    poses: Mapping[str, CameraPose] = field(default_factory=dict)

    def split(self, observation: RawObservation) -> tuple[np.ndarray, np.ndarray]:
        """Split one observation into `agent_pos` (agent_pos_dim,) and `environment_state` (environment_state_dim,).

        Args:
            observation: flat (D,), or a goal dictionary with `observation` (D,) and `desired_goal` (goal_dim,).
        """
        if not isinstance(observation, dict):
            observation = {"observation": observation}
        flat = observation["observation"]
        goal = observation["desired_goal"] if self.goal_dim else []
        return flat[list(self.agent)], np.concatenate([flat[list(self.scene)], goal])


def goal_reached(env: Any, observation: RawObservation, info: dict[str, Any]) -> bool:
    """Fetch: the achieved goal lies within 5 cm of the desired one. Can be told after a reset, too."""
    assert isinstance(observation, dict)
    return bool(env._is_success(observation["achieved_goal"], observation["desired_goal"]))


def _adroit_success(env: Any, observation: RawObservation, info: dict[str, Any]) -> bool:
    """Adroit: what the environment says; it says nothing after a reset."""
    return bool(info.get("success", False))


def _all_tasks_done(env: Any, observation: RawObservation, info: dict[str, Any]) -> bool:
    """Kitchen: every task of `tasks_to_complete` has been done at some step of the episode."""
    return set(env.goal) <= set(info["episode_task_completions"])


def _fetch(
    description: str,
    agent: Sequence[int],
    scene: Sequence[int],
    pose: CameraPose = FETCH_POSE,
    poses: Mapping[str, CameraPose] = FETCH_POSES,
) -> RoboticsTask:
    return RoboticsTask(
        description=description,
        fps=25,
        episode_length=50,
        action_dim=4,
        agent_pos_dim=len(agent),
        environment_state_dim=len(scene) + 3,
        agent=agent,
        scene=scene,
        goal_dim=3,
        success=goal_reached,
        pose=pose,
        poses=poses,
    )


def _adroit(description: str, agent: Sequence[int], dim: int, action_dim: int) -> RoboticsTask:
    """Of an observation (dim,), all that is not the hand's belongs to the scene."""
    return RoboticsTask(
        description=description,
        fps=100,
        episode_length=200,
        action_dim=action_dim,
        agent_pos_dim=len(agent),
        environment_state_dim=dim - len(agent),
        agent=agent,
        scene=sorted(set(range(dim)) - set(agent)),
        success=_adroit_success,
    )


# Grip position (3), finger displacements (2), grip velocity (3), finger velocities (2): an arm alone has these only.
ARM = (range(10), ())
# With an object, its position (3:6), position from the grip (6:9), rotation (11:14), velocity from the grip (14:17)
# and angular velocity (17:20) lie between them.
ARM_AND_OBJECT = ((0, 1, 2, 9, 10, 20, 21, 22, 23, 24), (*range(3, 9), *range(11, 20)))

KITCHEN = "FrankaKitchen-v1"
KITCHEN_TASKS = (
    "bottom burner",
    "top burner",
    "light switch",
    "slide cabinet",
    "hinge cabinet",
    "microwave",
    "kettle",
)
KITCHEN_DEFAULT = ("microwave", "kettle", "light switch", "slide cabinet")
"""The four of D4RL's `kitchen-complete` (arXiv:2004.07219)."""

TASKS: dict[str, RoboticsTask] = {
    "FetchReach-v4": _fetch("Move the gripper to the target position.", *ARM),
    "FetchPush-v4": _fetch("Push the block to the target position on the table.", *ARM_AND_OBJECT),
    "FetchPickAndPlace-v4": _fetch("Pick up the block and bring it to the target position.", *ARM_AND_OBJECT),
    "FetchSlide-v4": _fetch(
        "Hit the puck so that it slides to the target position.", *ARM_AND_OBJECT, SLIDE_POSE, SLIDE_POSES
    ),
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
    KITCHEN: RoboticsTask(
        description="Complete the kitchen tasks.",
        fps=12,
        episode_length=280,
        action_dim=9,
        agent_pos_dim=18,
        environment_state_dim=41,
        agent=range(18),
        scene=range(18, 59),
        success=_all_tasks_done,
    ),
}
