"""A scripted expert for ALOHA's cube transfer: a pure function of one observation.

The right hand picks the cube up and holds it out, the left hand takes it, the right one lets go and draws
back. The expert has no memory: its action follows from where hands, fingers and cube are. A cube
that falls is picked up again. Fingers cross at the cube: the right hand points down at an angle and closes
sideways, the left one lies flat and closes from above and below.

gym_aloha ends an episode as soon as the left hand's upper finger touches a cube that is off the table, before
the right hand lets go.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_agpd.envs.base import AGENT_POS
from lerobot_agpd.envs.experts.aloha_kinematics import HandPoses, arm_kinematics, rotation_vectors
from lerobot_agpd.envs.experts.aloha_servos import position_servos
from lerobot_agpd.envs.experts.base import Array, Expert, Observation, descend, ramp, state_vectors

# Places among the 14 numbers of `agent_pos` and of an action.
ARM_JOINTS = np.array([range(6), range(7, 13)])  # (2, 6)
GRIPPERS = np.array([6, 13])  # (2,)

# An intention of 1 moves the hand this far in one step of 20 ms along an axis, meters.
STRIDE = 0.006
# Fraction of a position error that a hand corrects in one step, when it is not limited by the stride.
POSITION_GAIN = 0.3
# Fastest turn of a hand, radians per step.
MAX_TURN = 0.06

OPEN, CLOSE = 1.0, -1.0  # of an intention; an action has 1 and 0

# Where the cube changes hands, and where the left hand waits for it, seen from there, meters. Low, so that a
# cube that is lost on the way is soon picked up again.
MEETING_POINT = np.array([0.0, 0.5, 0.15])
LEFT_STANDOFF = np.array([-0.1, 0.0, 0.0])
# Height of the right hand above the cube before it comes down, and its way back after the transfer, meters.
GRASP_CLEARANCE = 0.08
RETREAT = 0.10

# Fingers point along x and close along y of the hand's frame. The left hand is rolled by 90 degrees, the
# right one, which faces it, lowered by 60.
LEFT_ROTATION = Rotation.from_euler("X", 90, degrees=True)
RIGHT_ROTATION = Rotation.from_euler("ZY", [180, 60], degrees=True)
RIGHT_POINTS = RIGHT_ROTATION.as_matrix()[:, 0]


@dataclass(frozen=True)
class Hand:
    """One hand and the cube.

    Attributes:
        position: (3,) of the hand, meters, world frame.
        to_cube: (3,) from the hand to the cube's center.
        opening: of the gripper, 0 closed, 1 open, 0.61 around the cube.
    """

    position: Array
    to_cube: Array
    opening: float

    @property
    def surrounds(self) -> float:
        """How much the cube is between the fingers, in [0, 1]."""
        return ramp(float(np.linalg.norm(self.to_cube)), zero_at=0.025, one_at=0.015)

    @property
    def holds(self) -> float:
        """How much the hand has the cube, in [0, 1]."""
        return self.surrounds * ramp(self.opening, zero_at=0.65, one_at=0.62)


@dataclass(frozen=True)
class TransferScene:
    """One observation of the transfer, by name.

    Attributes:
        left: the left hand.
        right: the right hand.
        cube: (3,) position of the cube's center, meters, world frame.
        cube_heading: angle about the vertical of the cube's sides, radians, in [-pi/4, pi/4].
    """

    left: Hand
    right: Hand
    cube: Array
    cube_heading: float

    @classmethod
    def from_observation(cls, observation: Observation) -> "TransferScene":
        """Read `agent_pos` (14,) and `environment_state` (7,) of one environment.

        Raises:
            ValueError: if the shapes differ, for instance because the observation is batched.
        """
        agent, pose = state_vectors(observation, 14, 7)
        hands = zip(hand_positions(observation), agent[GRIPPERS], strict=True)
        left, right = (Hand(position, pose[:3] - position, float(opening)) for position, opening in hands)
        return cls(left, right, pose[:3], heading_of_sides(pose[3:]))


def heading_of_sides(quaternion: Array) -> float:
    """Angle about the vertical, in [-pi/4, pi/4], that aligns a hand with the cube's sides.

    Args:
        quaternion: (4,) of the cube, w first. Which side is up does not matter.
    """
    axes = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()[:2]  # (2, 3), seen from above
    x, y = axes[:, np.argmax(np.linalg.norm(axes, axis=0))]  # the most horizontal one
    return float((np.arctan2(y, x) + np.pi / 4) % (np.pi / 2) - np.pi / 4)


def hand_rotations(scene: TransferScene) -> Array:
    """Orientations (2, 3, 3) that the hands shall have.

    The left one is always turned alike. The right one follows the sides of the cube until it has it, and then
    faces the left one: from aside its fingers would be in the left one's way.
    """
    right = Rotation.from_euler("Z", (1.0 - scene.right.holds) * scene.cube_heading) * RIGHT_ROTATION
    return np.stack([LEFT_ROTATION.as_matrix(), right.as_matrix()])


def hand_positions(observation: Observation) -> Array:
    """Positions (2, 3) of the hands, meters, left first."""
    return arm_kinematics().forward(observation[AGENT_POS][ARM_JOINTS]).positions


def _intention(displacement: Array, closing: float) -> Array:
    """Intention (4,) for a displacement (3,) in meters, its direction kept, and fingers closing in [0, 1]."""
    motion = POSITION_GAIN * displacement / STRIDE
    return np.append(motion / max(1.0, float(np.abs(motion).max())), OPEN + (CLOSE - OPEN) * closing)


def intend_transfer(observation: Observation) -> Array:
    """Intentions of the two hands, stages blending into each other.

    Args:
        observation: `agent_pos` (14,), `environment_state` (7,).

    Returns:
        (2, 4), left hand first: displacement in units of `STRIDE`, in [-1, 1]; gripper, -1 closed, 1 open.

    Raises:
        ValueError: if the observation has other shapes.
    """
    scene = TransferScene.from_observation(observation)
    left = _intention(_left_displacement(scene), closing=scene.left.surrounds)
    right = _intention(_right_displacement(scene), closing=scene.right.surrounds * (1.0 - scene.left.holds))
    return np.stack([left, right])


def _right_displacement(scene: TransferScene) -> Array:
    """Come down onto the cube in a funnel, take it to the meeting point; draw back once the left has it."""
    to_cube = scene.right.to_cube
    fingers_shut = (1.0 - scene.right.surrounds) * ramp(scene.right.opening, zero_at=0.95, one_at=0.8)
    approach = descend(to_cube, GRASP_CLEARANCE, fingers_shut)
    pick_up = (1.0 - scene.right.holds) * approach + scene.right.holds * (MEETING_POINT - scene.cube)
    draw_back = to_cube - RETREAT * RIGHT_POINTS
    return (1.0 - scene.left.holds) * pick_up + scene.left.holds * draw_back


def _left_displacement(scene: TransferScene) -> Array:
    """Wait beside the meeting point, take the cube once it is held out there, and stay."""
    to_meeting_point = MEETING_POINT - scene.cube
    held_out = ramp(float(np.linalg.norm(to_meeting_point)), zero_at=0.03, one_at=0.015)
    wait = MEETING_POINT + LEFT_STANDOFF - scene.left.position
    take = held_out * scene.left.to_cube + (1.0 - held_out) * wait
    return (1.0 - scene.left.holds) * take + scene.left.holds * to_meeting_point


def joint_targets(observation: Observation, intention: Array) -> np.ndarray:
    """Turn the intentions of the hands into joint targets, and the hands toward `hand_rotations`.

    Args:
        observation: `agent_pos` (14,), `environment_state` (7,).
        intention: (2, 4), as `intend_transfer` gives it.

    Returns:
        Action (14,), float32: joint targets, radians, each arm's followed by its gripper's in [0, 1].
    """
    arms = arm_kinematics()
    scene = TransferScene.from_observation(observation)
    joints = np.asarray(observation[AGENT_POS], dtype=np.float64)[ARM_JOINTS]
    now = arms.forward(joints)
    turn = rotation_vectors(now, HandPoses(now.positions, hand_rotations(scene)))  # (2, 3)
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    turn *= np.minimum(1.0, MAX_TURN / np.maximum(angle, MAX_TURN))
    goal = HandPoses(
        positions=now.positions + STRIDE * intention[:, :3],
        rotations=Rotation.from_rotvec(turn).as_matrix() @ now.rotations,
    )
    action = np.empty(14, dtype=np.float32)
    action[ARM_JOINTS] = position_servos().targets(joints, arms.inverse(joints, goal) - joints)
    action[GRIPPERS] = np.clip((intention[:, 3] - CLOSE) / (OPEN - CLOSE), 0.0, 1.0)
    return action


EXPERTS: dict[str, Expert] = {
    "AlohaTransferCube-v0": Expert(intend_transfer, hands=hand_positions, act=joint_targets)
}
