"""Scripted experts for robomimic's lift and can: pure functions of one observation.

As in `experts.fetch`, experts have no memory and stages blend into each other. The intention of the hand
is a displacement and the gripper; `act` adds the rotation that keeps the hand pointing down, its fingers aligned with
the cube or with the bins.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_agpd.envs.experts.base import Array, Expert, Observation, descend, ramp, state_vectors
from lerobot_agpd.envs.robomimic_tasks import TASKS

# Action units per meter of position error. An action of 1 asks for 5 cm in one step, of which the arm does 1.1.
POSITION_GAIN = 20.0
# Action units per radian. An action of 1 asks for 0.5 rad in one step.
ROTATION_GAIN = 2.0

OPEN, CLOSE = -1.0, 1.0

# Height of the hand above the object's center before it comes down to grasp, meters.
GRASP_CLEARANCE = 0.09
# Where the cube is taken to: 8 cm above its place on the table; the episode ends half-way.
CUBE_HEIGHT = 0.90

# The can's compartment, a quarter of the second bin: center x, y of robosuite's `target_bin_placements`, meters.
CAN_GOAL = np.array([0.1975, 0.4025])
# Height of the can's center above the bins' walls and on the bins' floor.
CAN_CARRY_HEIGHT = 1.02
CAN_REST_HEIGHT = 0.86
# Height of the hand above the can's center when it grasps.
CAN_GRIP_HEIGHT = 0.02


@dataclass(frozen=True)
class PandaScene:
    """One observation of a task with one object, by name. Positions (3,) in meters, world frame, z up.

    Attributes:
        grip: position between the fingertips.
        hand: orientation of the hand, whose z axis points out between the fingers.
        width: distance between the fingers, 0 closed, 0.08 open.
        thing: position of the object's center.
        thing_rotation: its orientation.
    """

    grip: Array
    hand: Rotation
    width: float
    thing: Array
    thing_rotation: Rotation

    @classmethod
    def from_observation(cls, task: str, observation: Observation) -> "PandaScene":
        """Read `agent_pos` and `environment_state` of one environment.

        Raises:
            ValueError: if the shapes differ, for instance because the observation is batched.
        """
        spec = TASKS[task]
        agent, scene = state_vectors(observation, spec.agent_pos_dim, spec.environment_state_dim)
        pose = scene[:7] if task == "lift" else scene[7:14]  # can: the relative pose is first, and late
        return cls(
            grip=agent[:3],
            hand=Rotation.from_quat(agent[3:7]),
            width=float(agent[7] - agent[8]),
            thing=pose[:3],
            thing_rotation=Rotation.from_quat(pose[3:]),
        )

    def approach(self, to_grasp: Array, between_fingers: float) -> Array:
        """Displacement (3,) down onto a grasp, the object being between the fingers (1) or not yet (0)."""
        fingers_shut = (1.0 - between_fingers) * ramp(self.width, zero_at=0.075, one_at=0.065)
        return descend(to_grasp, GRASP_CLEARANCE, fingers_shut)


def _intention(displacement: Array, gripper: float) -> Array:
    """Proportional intention (4,) in [-1, 1] for a displacement (3,) in meters."""
    return np.clip(np.append(POSITION_GAIN * displacement, gripper), -1.0, 1.0)


def _gripper(closing: float) -> float:
    return OPEN + (CLOSE - OPEN) * closing


def lift_intention(observation: Observation) -> Array:
    """Descend onto the cube, close around it and rise.

    Args:
        observation: `agent_pos` (9,), `environment_state` (10,).

    Returns:
        Intention (4,).
    """
    scene = PandaScene.from_observation("lift", observation)
    to_cube = scene.thing - scene.grip
    between_fingers = ramp(float(np.linalg.norm(to_cube)), zero_at=0.025, one_at=0.012)
    held = between_fingers * ramp(scene.width, zero_at=0.055, one_at=0.048)

    rise = np.array([0.0, 0.0, CUBE_HEIGHT - scene.thing[2]])
    displacement = (1.0 - held) * scene.approach(to_cube, between_fingers) + held * rise
    return _intention(displacement, _gripper(between_fingers))


def can_intention(observation: Observation) -> Array:
    """Descend onto the can, close around it, carry it over the walls to its compartment, let go and rise.

    Args:
        observation: `agent_pos` (9,), `environment_state` (14,).

    Returns:
        Intention (4,).
    """
    scene = PandaScene.from_observation("can", observation)
    to_grasp = scene.thing + np.array([0.0, 0.0, CAN_GRIP_HEIGHT]) - scene.grip
    between_fingers = ramp(float(np.linalg.norm(to_grasp)), zero_at=0.025, one_at=0.012)
    held = between_fingers * ramp(scene.width, zero_at=0.060, one_at=0.054)

    to_goal = CAN_GOAL - scene.thing[:2]
    distance = float(np.linalg.norm(to_goal))
    above_goal = ramp(distance, zero_at=0.12, one_at=0.06)
    low = ramp(scene.thing[2], zero_at=CAN_REST_HEIGHT + 0.03, one_at=CAN_REST_HEIGHT + 0.015)
    arrived = above_goal * low

    height = CAN_CARRY_HEIGHT + above_goal * (CAN_REST_HEIGHT - CAN_CARRY_HEIGHT)
    high_enough = ramp(scene.thing[2], zero_at=CAN_CARRY_HEIGHT - 0.06, one_at=CAN_CARRY_HEIGHT - 0.02)
    may_travel = max(high_enough, above_goal)
    carry = np.append(may_travel * to_goal, height - scene.thing[2])

    working = (1.0 - held) * scene.approach(to_grasp, between_fingers) + held * carry
    retreat = np.array([0.0, 0.0, 0.05 * ramp(scene.width, zero_at=0.055, one_at=0.065)])
    displacement = (1.0 - arrived) * working + arrived * retreat
    return _intention(displacement, _gripper(between_fingers * (1.0 - arrived)))


def _yaw(axis: Array) -> float:
    return float(np.arctan2(axis[1], axis[0]))


def downward_rotation(task: str, observation: Observation) -> Array:
    """Rotation action (3,) that points the hand down and turns its fingers parallel to a face.

    Four turns of the hand do equally well; the nearest is taken.

    Args:
        task: `lift`, where the face is the cube's, or `can`, where it is a wall of the bins.
        observation: of that task.
    """
    scene = PandaScene.from_observation(task, observation)
    hand = scene.hand.as_matrix()
    tilt = np.cross(hand[:, 2], [0.0, 0.0, -1.0])
    goal_yaw = 0.0
    if task == "lift":
        axes = scene.thing_rotation.as_matrix().T  # (3, 3), one axis per row
        goal_yaw = _yaw(max(axes, key=lambda axis: float(np.hypot(axis[0], axis[1]))))
    quarter = np.pi / 2
    turn = (goal_yaw - _yaw(hand[:, 0]) + quarter / 2) % quarter - quarter / 2
    return np.clip(ROTATION_GAIN * (tilt + np.array([0.0, 0.0, turn])), -1.0, 1.0)


def panda_action(task: str, observation: Observation, intention: Array) -> np.ndarray:
    """Action (7,), float32, of an intention (1, 4): displacement, rotation, gripper."""
    ((*displacement, gripper),) = intention
    action = np.concatenate([displacement, downward_rotation(task, observation), [gripper]])
    return np.clip(action, -1.0, 1.0).astype(np.float32)


EXPERTS: dict[str, Expert] = {
    "lift": Expert(lift_intention, act=partial(panda_action, "lift")),
    "can": Expert(can_intention, act=partial(panda_action, "can")),
}
