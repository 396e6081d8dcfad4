"""Torques of robosuite's operational space controller (`OSC_POSE`), in a fraction of its time."""

from typing import Any

import mujoco
import numpy as np

from lerobot_agpd.envs.ways import Array

POSTURE_STIFFNESS = 10.0
"""Stiffness of the arm's redundant joint about its resting posture, 1/s^2; robosuite's."""


class OperationalSpace:
    """What robosuite's controller computes (Khatib, 1987), for one arm whose base stands still.

    With goals, gains and resting posture of `arm`, the same torques up to rounding: linear systems are solved where
    robosuite inverts matrices, and a Jacobian is computed once.
    """

    def __init__(self, arm: Any, model: mujoco.MjModel) -> None:
        """Take over a controller.

        Args:
            arm: robosuite's `OperationalSpaceController` with uncoupled position and orientation.
            model: of the simulation.
        """
        self._arm, self._model = arm, model
        self._site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, arm.ref_name)
        self._jacobian = np.zeros((6, model.nv))
        self._mass = np.zeros((model.nv, model.nv))
        self._joints = np.ix_(arm.qvel_index, arm.qvel_index)

    def torques(self, data: mujoco.MjData) -> Array:
        """Torques (joints,) for the current state, gravity compensated."""
        arm, dofs = self._arm, self._arm.qvel_index
        mujoco.mj_jacSite(self._model, data, self._jacobian[:3], self._jacobian[3:], self._site)
        mujoco.mj_fullM(self._model, self._mass, data.qM)
        jacobian, mass = self._jacobian[:, dofs], self._mass[self._joints]
        joint_velocity = data.qvel[dofs]
        error = np.concatenate([arm.goal_pos - data.site_xpos[self._site], self._rotation_error(data)])
        wanted = arm.kp * error - arm.kd * (jacobian @ joint_velocity)  # acceleration of the hand

        inverse_inertia = jacobian @ np.linalg.solve(mass, jacobian.T)  # (6, 6), of the hand
        position, rotation = slice(0, 3), slice(3, 6)
        wrench = np.concatenate(
            [np.linalg.solve(inverse_inertia[part, part], wanted[part]) for part in (position, rotation)]
        )
        damping = 2.0 * np.sqrt(POSTURE_STIFFNESS)
        posture = (
            POSTURE_STIFFNESS * (arm.initial_joint - data.qpos[arm.qpos_index]) - damping * joint_velocity
        )
        wrench -= np.linalg.solve(inverse_inertia, jacobian @ posture)  # the posture must not move the hand
        return jacobian.T @ wrench + mass @ posture + data.qfrc_bias[dofs]

    def _rotation_error(self, data: mujoco.MjData) -> Array:
        """Rotation (3,) from the current to the wanted orientation, for small ones."""
        e = self._arm.goal_ori @ data.site_xmat[self._site].reshape(3, 3).T
        return 0.5 * np.array([e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]])
