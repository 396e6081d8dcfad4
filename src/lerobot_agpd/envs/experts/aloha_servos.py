"""Targets for ALOHA's simulated position servos that move a joint a given distance in one step.

The servos are springs, torque = kp * (target - position), that pull against strong dry friction (gym_aloha's
`frictionloss`). A target one step ahead hardly moves the arm. MuJoCo softens friction: below its limit a
joint creeps,

    velocity = torque * R / b,    R = (1 - d) / d * invweight0,    b = 2 / (d_max * timeconst)

with the constraint's impedance d, d_max and time constant (MuJoCo documentation, "Constraint model"). The
distance to the target therefore decays by a known factor per step. Above the limit the joint breaks loose.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from lerobot_agpd.envs.experts.aloha_kinematics import MODEL_JOINTS, arm_kinematics
from lerobot_agpd.envs.experts.base import Array

CONTROL_STEP = 0.02  # seconds
# How far a joint gets in a step per radian of target beyond what friction holds. Measured for waist and
# shoulder, which alone need it: 1.9 to 2.2 in three poses.
LOOSE_RATE = 2.0


@dataclass(frozen=True)
class PositionServos:
    """The arms' servos.

    Attributes:
        stiffness: (2, 6) kp, newton meters per radian.
        creep_rate: (2, 6) fraction of the distance to the target that a creeping joint covers in one step.
        friction_limit: (2, 6) distance to the target at which a joint breaks loose, radians.
    """

    stiffness: Array
    creep_rate: Array
    friction_limit: Array

    def targets(self, joints: Array, step: Array) -> Array:
        """Targets that move the joints by `step` within one control step, gravity compensated.

        Args:
            joints: (2, 6) positions, radians.
            step: (2, 6) motion, radians.

        Returns:
            (2, 6), radians, within the actuators' range.
        """
        arms = arm_kinematics()
        fastest_creep = self.creep_rate * self.friction_limit
        creep = np.clip(step, -fastest_creep, fastest_creep)
        lead = creep / self.creep_rate + (step - creep) / LOOSE_RATE
        sag = arms.gravity_torques(joints) / self.stiffness
        return np.clip(joints + lead + sag, arms.low, arms.high)


@cache
def position_servos() -> PositionServos:
    """Return the servos as the model describes them."""
    model = arm_kinematics().model
    stiffness = model.actuator_gainprm[MODEL_JOINTS, 0]
    timeconst = model.dof_solref[MODEL_JOINTS, 0]
    d, d_max = np.moveaxis(model.dof_solimp[MODEL_JOINTS, :2], -1, 0)
    softness = (1 - d) / d * model.dof_invweight0[MODEL_JOINTS]
    per_second = stiffness * softness * d_max * timeconst / 2
    return PositionServos(
        stiffness=stiffness,
        creep_rate=1 - np.exp(-CONTROL_STEP * per_second),
        friction_limit=model.dof_frictionloss[MODEL_JOINTS] / stiffness,
    )
