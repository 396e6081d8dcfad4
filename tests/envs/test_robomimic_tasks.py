"""The table of robomimic's tasks."""

import pytest

from lerobot_agpd.envs.robomimic_tasks import TASKS, key_dim


@pytest.mark.parametrize(
    ("task", "agent_pos", "environment_state", "action"),
    [
        ("lift", 9, 10, 7),
        ("can", 9, 14, 7),
        ("square", 9, 14, 7),
        ("transport", 18, 41, 14),
        ("tool_hang", 9, 44, 7),
    ],
)
def test_lengths_are_those_of_robomimics_files(task, agent_pos, environment_state, action):
    spec = TASKS[task]
    declared = (spec.agent_pos_dim, spec.environment_state_dim, spec.action_dim)
    assert declared == (agent_pos, environment_state, action)
    of_keys = tuple(sum(map(key_dim, keys)) for keys in (spec.agent_keys, spec.object_keys))
    assert declared[:2] == of_keys


@pytest.mark.parametrize(
    ("key", "dim"),
    [
        ("robot0_eef_pos", 3),
        ("robot1_eef_quat", 4),
        ("robot0_gripper_qpos", 2),
        ("gripper0_to_payload", 3),
        ("gripper_to_cube_pos", 3),
        ("tool_on_frame", 1),
    ],
)
def test_length_of_a_key(key, dim):
    assert key_dim(key) == dim


@pytest.mark.parametrize("task", TASKS)
def test_both_versions_of_robosuite_observe_the_same_things(task):
    assert sorted(TASKS[task].object_keys) == sorted(TASKS[task].object_keys_v141)


def test_arms_come_one_after_the_other():
    keys = TASKS["transport"].agent_keys
    assert keys[:3] == ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")
    assert keys[3:] == ("robot1_eef_pos", "robot1_eef_quat", "robot1_gripper_qpos")
