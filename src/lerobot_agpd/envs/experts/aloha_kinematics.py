"""Forward and inverse kinematics of ALOHA's two arms, on a model of their own that no simulation shares.

The inverse is damped least squares (Wampler 1986, doi:10.1109/TSMC.1986.289285): exact where an arm moves
freely, slow instead of violent near a singularity.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_agpd.envs.experts.base import Array

ARMS = ("left", "right")
ARM_DOF = 6
MODEL_JOINTS = np.array([range(6), range(8, 14)])
"""Places (2, 6) of the arms' joints in MuJoCo's model, where every gripper has two fingers."""

# The hand is a point between the fingers, this far ahead of the gripper's origin, meters. They end at 0.154.
HAND_OFFSET = 0.14

DAMPING = 0.01  # meters
METERS_PER_RADIAN = 0.1  # what an orientation error weighs against a position error
ITERATIONS = 2


@dataclass(frozen=True)
class HandPoses:
    """Where both hands are, left first, in the world frame.

    Attributes:
        positions: (2, 3), meters.
        rotations: (2, 3, 3); columns are where the fingers point, the axis along which they close, and their
            cross product.
    """

    positions: Array
    rotations: Array


class ArmKinematics:
    """Joint positions to hand poses and back.

    The model's data is scratch that every call overwrites: results depend on arguments alone. Not for several
    threads.

    Attributes:
        model: MuJoCo's model of the scene.
        low: (2, 6) lower ends of what the arms' actuators accept, radians.
        high: (2, 6) upper ends.
    """

    def __init__(self) -> None:
        """Load the arms.

        Raises:
            ModuleNotFoundError: if gym_aloha is not installed.
        """
        import mujoco
        from gym_aloha.constants import ASSETS_DIR

        self._mujoco: Any = mujoco
        self.model = mujoco.MjModel.from_xml_path(str(ASSETS_DIR / "bimanual_viperx_transfer_cube.xml"))
        self._data = mujoco.MjData(self.model)
        self._hands = [self.model.body(f"vx300s_{arm}/gripper_link").id for arm in ARMS]
        limits = self.model.actuator_ctrlrange[
            MODEL_JOINTS
        ]  # (2, 6, 2), one actuator per joint, in their order
        self.low, self.high = limits[..., 0], limits[..., 1]

    def forward(self, joints: Array) -> HandPoses:
        """Hand poses at joint positions (2, 6), radians, left arm first."""
        self._data.qpos[MODEL_JOINTS] = joints
        self._mujoco.mj_kinematics(self.model, self._data)
        rotations = self._data.xmat[self._hands].reshape(2, 3, 3)
        return HandPoses(self._data.xpos[self._hands] + HAND_OFFSET * rotations[:, :, 0], rotations)

    def inverse(self, joints: Array, goal: HandPoses) -> Array:
        """Find joint positions near given ones whose hand poses are near a goal, within the actuators' range.

        Made for a goal that is one control step away: `ITERATIONS` steps of damped least squares.

        Args:
            joints: (2, 6) where to start, radians.
            goal: poses to reach.

        Returns:
            (2, 6), radians.
        """
        solution = np.clip(joints, self.low, self.high)
        for _ in range(ITERATIONS):
            poses = self.forward(solution)
            error = np.concatenate(
                [goal.positions - poses.positions, METERS_PER_RADIAN * rotation_vectors(poses, goal)], axis=1
            )
            jacobians = self._jacobians_here(poses)  # (2, 6, 6)
            transposed = jacobians.transpose(0, 2, 1)
            damped = jacobians @ transposed + DAMPING**2 * np.eye(6)
            step = transposed @ np.linalg.solve(damped, error[..., None])  # (2, 6, 1)
            solution = np.clip(solution + step[..., 0], self.low, self.high)
        return solution

    def gravity_torques(self, joints: Array) -> Array:
        """Torques (2, 6), N m, that hold the arms still at joint positions (2, 6), friction aside."""
        self.forward(joints)
        self._mujoco.mj_comPos(self.model, self._data)
        torques = np.empty(self.model.nv)
        self._mujoco.mj_rne(self.model, self._data, 0, torques)  # velocities are zero
        return torques[MODEL_JOINTS]

    def _jacobians_here(self, poses: HandPoses) -> Array:
        """Derivatives (2, 6, 6) of the hands' position and weighted orientation, where `forward` was last."""
        self._mujoco.mj_comPos(self.model, self._data)
        jacobians = np.empty((2, 6, ARM_DOF))
        of_all_joints = np.empty((6, self.model.nv))
        for arm, (body, position) in enumerate(zip(self._hands, poses.positions, strict=True)):
            self._mujoco.mj_jac(self.model, self._data, of_all_joints[:3], of_all_joints[3:], position, body)
            jacobians[arm] = of_all_joints[:, MODEL_JOINTS[arm]]
        jacobians[:, 3:] *= METERS_PER_RADIAN
        return jacobians


def rotation_vectors(start: HandPoses, end: HandPoses) -> Array:
    """World-frame rotations (2, 3), radians, that turn the hands of `start` into those of `end`."""
    return Rotation.from_matrix(end.rotations @ start.rotations.transpose(0, 2, 1)).as_rotvec()


@cache
def arm_kinematics() -> ArmKinematics:
    """Return the kinematics of this process."""
    return ArmKinematics()
