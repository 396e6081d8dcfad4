"""Kinematics and servos of ALOHA's arms against MuJoCo's own."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from lerobot_agpd.envs.aloha import AlohaStateEnvConfig
from lerobot_agpd.envs.base import AGENT_POS
from lerobot_agpd.envs.experts.aloha import ARM_JOINTS, GRIPPERS
from lerobot_agpd.envs.experts.aloha_kinematics import (
    HAND_OFFSET,
    ArmKinematics,
    HandPoses,
    arm_kinematics,
    rotation_vectors,
)
from lerobot_agpd.envs.experts.aloha_servos import position_servos

pytest.importorskip("gym_aloha")
REST = np.array([[0.0, -0.96, 1.16, 0.0, -0.3, 0.0]] * 2)
BENT = np.array([[0.2, -0.7, 0.9, -0.2, 0.8, 0.2]] * 2)  # away from singularities
small = arrays(np.float64, (2, 6), elements=st.floats(-0.2, 0.2))
unit = arrays(np.float64, (2, 3), elements=st.floats(-1, 1))


@pytest.fixture(scope="module")
def env():
    return AlohaStateEnvConfig().make_single()


def test_hands_are_between_the_fingers_of_the_simulation(env):
    observation, _ = env.reset(seed=0)
    physics = env.unwrapped._env.physics
    hands = arm_kinematics().forward(observation[AGENT_POS][ARM_JOINTS].astype(np.float64)).positions
    for hand, arm in zip(hands, ("left", "right"), strict=True):
        palm = physics.named.data.xpos[f"vx300s_{arm}/gripper_link"]
        points = physics.named.data.xmat[f"vx300s_{arm}/gripper_link"].reshape(3, 3)[:, 0]
        np.testing.assert_allclose(hand, palm + HAND_OFFSET * points, atol=1e-6)
    np.testing.assert_allclose(hands[0] + hands[1], [0, 1.0, 2 * hands[0][2]], atol=1e-5)  # mirrored at x = 0


@settings(max_examples=60, deadline=None)
@given(around=small, displacement=unit, turn=unit)
def test_inverse_reaches_a_pose_one_step_away(around, displacement, turn):
    arms = arm_kinematics()
    joints = BENT + around
    start = arms.forward(joints)
    goal = HandPoses(
        start.positions + 0.006 * displacement,
        Rotation.from_rotvec(0.03 * turn).as_matrix() @ start.rotations,
    )
    reached = arms.forward(arms.inverse(joints, goal))
    np.testing.assert_allclose(reached.positions, goal.positions, atol=3e-4)
    assert np.abs(rotation_vectors(reached, goal)).max() < 5e-3


@settings(max_examples=30, deadline=None)
@given(around=small)
def test_inverse_of_where_the_hands_are_changes_nothing(around):
    arms = arm_kinematics()
    np.testing.assert_allclose(
        arms.inverse(BENT + around, arms.forward(BENT + around)), BENT + around, atol=1e-9
    )


def test_inverse_stays_within_the_actuators_range():
    arms = arm_kinematics()
    joints = REST.copy()
    for _ in range(60):  # far beyond what the arms reach
        poses = arms.forward(joints)
        joints = arms.inverse(joints, HandPoses(poses.positions + [0, 0, 0.05], poses.rotations))
        assert (joints >= arms.low).all() and (joints <= arms.high).all()


def test_results_depend_on_the_arguments_alone():
    arms = arm_kinematics()
    goal = HandPoses(arms.forward(BENT).positions + 0.005, arms.forward(BENT).rotations)
    before = arms.inverse(BENT, goal)
    arms.gravity_torques(REST)
    np.testing.assert_array_equal(arms.inverse(BENT, goal), before)


def test_gravity_torques_are_the_slope_of_the_potential_energy():
    import mujoco

    arms = ArmKinematics()  # its model's options are changed below
    data = mujoco.MjData(arms.model)
    arm_dofs = [*range(6), *range(8, 14)]
    arms.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY

    def energy(joints):
        data.qpos[arm_dofs] = joints.reshape(-1)
        mujoco.mj_forward(arms.model, data)
        return data.energy[0]

    slopes = np.array(
        [(energy(BENT + e) - energy(BENT - e)) / 2e-5 for e in 1e-5 * np.eye(12).reshape(12, 2, 6)]
    )
    np.testing.assert_allclose(arms.gravity_torques(BENT).reshape(-1), slopes, atol=1e-3)


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("step", [-0.006, 0.006, 0.02])
def test_servos_move_a_joint_by_about_the_wanted_step(env, joint, step):
    observation, _ = env.reset(seed=0)
    wanted = np.zeros((2, 6))
    wanted[:, joint] = step
    positions = []
    for _ in range(10):
        joints = observation[AGENT_POS][ARM_JOINTS].astype(np.float64)
        positions.append(joints)
        action = np.empty(14, dtype=np.float32)
        action[ARM_JOINTS] = position_servos().targets(joints, wanted)
        action[GRIPPERS] = observation[AGENT_POS][GRIPPERS]
        observation, *_ = env.step(action)
    steps = np.diff(positions, axis=0)[2:].mean(axis=0)  # (2, 6)
    np.testing.assert_allclose(steps, wanted, atol=0.25 * abs(step))


def test_servos_hold_still_against_gravity(env):
    observation, _ = env.reset(seed=0)
    joints = observation[AGENT_POS][ARM_JOINTS].astype(np.float64)
    action = np.empty(14, dtype=np.float32)
    action[ARM_JOINTS] = position_servos().targets(joints, np.zeros((2, 6)))
    action[GRIPPERS] = observation[AGENT_POS][GRIPPERS]
    for _ in range(50):
        observation, *_ = env.step(action)
    np.testing.assert_allclose(
        observation[AGENT_POS][ARM_JOINTS], joints, atol=5e-4
    )  # 9e-3 without compensation
