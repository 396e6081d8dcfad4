"""The scripted experts for robomimic's lift and can."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE
from lerobot_agpd.envs.experts import make_expert
from lerobot_agpd.envs.experts.robomimic import (
    CAN_CARRY_HEIGHT,
    CAN_GOAL,
    CAN_GRIP_HEIGHT,
    CAN_REST_HEIGHT,
    CLOSE,
    EXPERTS,
    OPEN,
    can_intention,
    downward_rotation,
    lift_intention,
)
from lerobot_agpd.envs.operators import Operator
from lerobot_agpd.envs.robomimic import RobomimicEnvConfig
from lerobot_agpd.envs.robomimic_tasks import TASKS

DOWN = Rotation.from_euler("x", np.pi)
UPRIGHT = Rotation.identity()


def observe(task, grip, thing, width=0.08, hand=DOWN, thing_rotation=UPRIGHT) -> dict[str, np.ndarray]:
    """Raw observation of a hand and one object."""
    agent = np.concatenate([grip, hand.as_quat(), [width / 2, -width / 2]])
    pose = np.concatenate([thing, thing_rotation.as_quat()])
    relative = np.subtract(thing, grip)
    scene = [pose, relative] if task == "lift" else [relative, [0, 0, 0, 1], pose]
    state = np.concatenate(scene)
    return {AGENT_POS: agent.astype(np.float32), ENVIRONMENT_STATE: state.astype(np.float32)}


def test_lift_stages():
    cube = np.array([0.01, 0.02, 0.82])
    far = lift_intention(observe("lift", cube + [-0.2, 0, 0.09], cube))
    np.testing.assert_allclose(far, [1.0, 0.0, 0.0, OPEN], atol=1e-4)  # across, at the safe height, open

    above = lift_intention(observe("lift", cube + [0, 0, 0.09], cube))
    np.testing.assert_allclose(above, [0.0, 0.0, -1.0, OPEN], atol=1e-4)  # come down

    around = lift_intention(observe("lift", cube, cube))
    np.testing.assert_allclose(around, [0.0, 0.0, 0.0, CLOSE], atol=1e-4)  # wait and close

    held = lift_intention(observe("lift", cube, cube, width=0.042))
    np.testing.assert_allclose(held, [0.0, 0.0, 1.0, CLOSE], atol=1e-4)  # rise

    shut = lift_intention(observe("lift", cube + [0, 0, 0.05], cube, width=0.0))
    assert shut[2] > 0 and shut[3] == OPEN  # open first, higher up


def test_can_stages():
    can = np.array([0.1, -0.25, CAN_REST_HEIGHT])
    grasp = np.array([0.0, 0.0, CAN_GRIP_HEIGHT])
    held = can_intention(observe("can", can + grasp, can, width=0.05))
    np.testing.assert_allclose(held, [0.0, 0.0, 1.0, CLOSE], atol=1e-4)  # straight up out of the bin

    high = np.array([CAN_GOAL[0], -0.25, CAN_CARRY_HEIGHT])
    carried = can_intention(observe("can", high + grasp, high, width=0.05))
    np.testing.assert_allclose(carried, [0.0, 1.0, 0.0, CLOSE], atol=1e-4)  # across

    above_goal = np.append(CAN_GOAL, CAN_CARRY_HEIGHT)
    arriving = can_intention(observe("can", above_goal + grasp, above_goal, width=0.05))
    np.testing.assert_allclose(arriving, [0.0, 0.0, -1.0, CLOSE], atol=1e-4)  # down

    placed = np.append(CAN_GOAL, CAN_REST_HEIGHT)
    arrived = can_intention(observe("can", placed + grasp, placed, width=0.05))
    np.testing.assert_allclose(arrived, [0.0, 0.0, 0.0, OPEN], atol=1e-4)  # let go
    retreating = can_intention(observe("can", placed + grasp, placed, width=0.075))
    np.testing.assert_allclose(retreating, [0.0, 0.0, 1.0, OPEN], atol=1e-4)  # and leave


@pytest.mark.parametrize(
    ("hand_yaw", "cube_yaw", "turn"),
    [(0.0, 0.2, 0.2), (0.1, -0.1, -0.2), (0.0, np.pi / 2 - 0.3, -0.3), (3.0, 3.0 + np.pi + 0.1, 0.1)],
)
def test_the_hand_turns_the_shortest_way_to_a_face_of_the_cube(hand_yaw, cube_yaw, turn):
    hand = Rotation.from_euler("z", hand_yaw) * DOWN
    observation = observe(
        "lift", np.zeros(3), np.zeros(3), hand=hand, thing_rotation=Rotation.from_euler("z", cube_yaw)
    )
    np.testing.assert_allclose(downward_rotation("lift", observation), [0, 0, 2 * turn], atol=1e-5)


def test_a_tilted_hand_turns_back():
    for tilt in (np.array([0.1, 0.0, 0.0]), np.array([0.0, -0.2, 0.0])):
        observation = observe("can", np.zeros(3), np.zeros(3), hand=Rotation.from_rotvec(tilt) * DOWN)
        expected = -2 * np.sin(np.linalg.norm(tilt)) * tilt / np.linalg.norm(tilt)
        np.testing.assert_allclose(downward_rotation("can", observation)[:2], expected[:2], atol=1e-5)


def test_a_cube_on_another_face_has_the_same_directions():
    yaw = Rotation.from_euler("z", 0.3)
    turns = [
        downward_rotation("lift", observe("lift", np.zeros(3), np.zeros(3), thing_rotation=yaw * roll))
        for roll in (UPRIGHT, Rotation.from_euler("x", np.pi / 2), Rotation.from_euler("y", -np.pi / 2))
    ]
    np.testing.assert_allclose(turns, [[0, 0, 0.6]] * 3, atol=1e-5)


@pytest.mark.parametrize("task", EXPERTS)
@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_any_observation_gets_a_valid_action_and_always_the_same(task, data):
    numbers = st.floats(-3, 3, width=32)
    spec = TASKS[task]
    observation = {
        AGENT_POS: data.draw(arrays(np.float32, spec.agent_pos_dim, elements=numbers)),
        ENVIRONMENT_STATE: data.draw(arrays(np.float32, spec.environment_state_dim, elements=numbers)),
    }
    observation[AGENT_POS][6] = observation[ENVIRONMENT_STATE][6] = observation[ENVIRONMENT_STATE][-1] = 0.5
    before = {key: value.copy() for key, value in observation.items()}
    action = EXPERTS[task](observation)
    assert action.shape == (7,) and action.dtype == np.float32
    assert np.all(np.abs(action) <= 1)
    np.testing.assert_array_equal(action, EXPERTS[task](observation))
    for key, value in before.items():
        np.testing.assert_array_equal(observation[key], value)


@pytest.mark.parametrize("task", EXPERTS)
def test_intention_becomes_displacement_and_gripper_of_the_action(task):
    observation = observe(task, np.zeros(3), np.zeros(3))
    action = EXPERTS[task].act(observation, np.array([[0.1, 0.2, -0.3, 1.0]]))
    np.testing.assert_allclose(action, [0.1, 0.2, -0.3, 0, 0, 0, 1], atol=1e-5)


def test_batched_observation_is_refused():
    batched = {key: value[None] for key, value in observe("lift", np.zeros(3), np.zeros(3)).items()}
    with pytest.raises(ValueError, match="single environment"):
        lift_intention(batched)


def test_tasks_without_an_expert_are_refused():
    assert make_expert(RobomimicEnvConfig(task="can")) is EXPERTS["can"]
    with pytest.raises(ValueError, match="square"):
        make_expert(RobomimicEnvConfig(task="square"))


def play(env, expert, seed: int) -> tuple[np.ndarray, bool]:
    """Actions (T, 7) and whether the episode ended in success."""
    env.reset(seed=seed)
    actions, ended = [], False
    while not ended:
        actions.append(expert(env.get_wrapper_attr("state")))
        _, _, terminated, truncated, _ = env.step(actions[-1])
        ended = terminated or truncated
    return np.stack(actions), terminated


def test_lift_succeeds_and_closes_once():
    pytest.importorskip("robosuite")
    env = RobomimicEnvConfig(task="lift").make_single()
    for seed in range(2):
        actions, success = play(env, EXPERTS["lift"], seed)
        assert success and len(actions) < 40
        assert (np.diff(np.sign(actions[:, 6])) != 0).sum() == 1
    env.close()


@pytest.mark.slow
def test_can_succeeds():
    pytest.importorskip("robosuite")
    env = RobomimicEnvConfig(task="can").make_single()
    assert [seed for seed in range(4) if not play(env, EXPERTS["can"], seed)[1]] == []
    env.close()


@pytest.mark.slow
def test_operators_of_half_the_skill_succeed_later():
    pytest.importorskip("robosuite")
    env = RobomimicEnvConfig(task="lift").make_single()
    lengths = []
    for seed in range(5):
        operator = Operator(EXPERTS["lift"], 0.5, np.random.default_rng(seed))
        actions, success = play(env, operator, seed)
        assert success
        lengths.append(len(actions))
    assert np.mean(lengths) > 30  # the expert takes 24 to 28
    env.close()
