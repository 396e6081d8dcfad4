"""The table of Gymnasium-Robotics tasks against the simulations themselves."""

import numpy as np
import pytest

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.robotics_tasks import KITCHEN, KITCHEN_TASKS, TASKS

pytest.importorskip("gymnasium_robotics")

DIMENSIONS = {
    "FetchReach-v4": (10, 3, 4),
    "FetchPush-v4": (10, 18, 4),
    "FetchPickAndPlace-v4": (10, 18, 4),
    "FetchSlide-v4": (10, 18, 4),
    "AdroitHandDoor-v1": (30, 9, 28),
    "AdroitHandHammer-v1": (29, 17, 26),
    "AdroitHandPen-v1": (24, 21, 24),
    "AdroitHandRelocate-v1": (30, 9, 30),
    "FrankaKitchen-v1": (18, 41, 9),
}
FETCH = [task for task in TASKS if task.startswith("Fetch")]


def observe(task: str, seed: int = 3):
    """The simulation and its first observation."""
    env = GymnasiumRoboticsEnv(task=task).make_single()
    observation, _ = env.reset(seed=seed)
    return env.unwrapped, observation[AGENT_POS], observation[ENVIRONMENT_STATE]


@pytest.mark.parametrize("task", TASKS)
def test_declared_dimensions_are_the_simulations(task):
    env = GymnasiumRoboticsEnv(task=task).make_single()
    observation, _ = env.reset(seed=0)
    spec = TASKS[task]
    shown = (len(observation[AGENT_POS]), len(observation[ENVIRONMENT_STATE]), env.action_space.shape[0])
    declared = (spec.agent_pos_dim, spec.environment_state_dim, spec.action_dim)
    assert shown == declared == DIMENSIONS[task]
    assert spec.fps == env.metadata["render_fps"]
    np.testing.assert_array_equal(env.action_space.high, 1)


@pytest.mark.parametrize("task", FETCH)
def test_fetch_layout_holds_what_its_names_say(task):
    raw, agent, scene = observe(task)
    grip = raw._utils.get_site_xpos(raw.model, raw.data, "robot0:grip")
    np.testing.assert_allclose(agent[:3], grip, rtol=1e-6)
    np.testing.assert_allclose(scene[-3:], raw.goal, rtol=1e-6)
    if raw.has_object:
        block = raw._utils.get_site_xpos(raw.model, raw.data, "object0")
        np.testing.assert_allclose(scene[:3], block, rtol=1e-6)
        np.testing.assert_allclose(scene[3:6], block - grip, atol=1e-6)


def test_door_layout_holds_what_its_names_say():
    raw, agent, scene = observe("AdroitHandDoor-v1")
    np.testing.assert_allclose(agent[:27], raw.data.qpos[1:28], rtol=1e-6)
    np.testing.assert_allclose(agent[27:], raw.data.site_xpos[raw.grasp_site_id], rtol=1e-6)
    handle = raw.data.site_xpos[raw.handle_site_id]
    np.testing.assert_allclose(scene[2:5], handle, rtol=1e-6)
    np.testing.assert_allclose(scene[5:8], agent[27:] - handle, atol=1e-6)
    assert scene[8] == -1  # closed


def test_hammer_layout_holds_what_its_names_say():
    raw, agent, scene = observe("AdroitHandHammer-v1")
    np.testing.assert_allclose(agent[:26], raw.data.qpos[:26], rtol=1e-6)
    np.testing.assert_allclose(agent[26:], raw.data.site_xpos[raw.S_grasp_site_id], rtol=1e-6)
    assert scene[0] == pytest.approx(raw.data.qpos[26])  # how far the nail is in
    np.testing.assert_allclose(scene[7:10], raw.data.xpos[raw.obj_body_id], rtol=1e-6)
    np.testing.assert_allclose(scene[13:16], raw.data.site_xpos[raw.target_obj_site_id], rtol=1e-6)


def test_pen_layout_holds_what_its_names_say():
    raw, agent, scene = observe("AdroitHandPen-v1")
    np.testing.assert_allclose(agent, raw.data.qpos[:24], rtol=1e-6)
    np.testing.assert_allclose(scene[:3], raw.data.xpos[raw.obj_body_id], rtol=1e-6)
    np.testing.assert_allclose(scene[-3:], scene[9:12] - scene[12:15], atol=1e-6)  # orientation still to turn


def test_relocate_layout_holds_what_its_names_say():
    raw, agent, scene = observe("AdroitHandRelocate-v1")
    np.testing.assert_allclose(agent, raw.data.qpos[:30], rtol=1e-6)
    ball, target = raw.data.xpos[raw.obj_body_id], raw.data.site_xpos[raw.target_obj_site_id]
    np.testing.assert_allclose(scene[-3:], ball - target, atol=1e-6)


def test_kitchen_layout_holds_what_its_names_say():
    raw, agent, scene = observe(KITCHEN)
    # The kitchen adds noise to what it observes.
    np.testing.assert_allclose(agent[:9], raw.data.qpos[:9], atol=0.01)
    np.testing.assert_allclose(scene[:21], raw.data.qpos[9:], atol=0.01)


def test_fetch_success_means_within_five_centimeters():
    env = GymnasiumRoboticsEnv(task="FetchReach-v4").make_single()
    seen = set()
    for seed in range(20):
        observation, info = env.reset(seed=seed)
        for step in range(4):
            if step:
                action = np.random.default_rng([seed, step]).uniform(-1, 1, 4).astype(np.float32)
                observation, _, _, _, info = env.step(action)
            distance = np.linalg.norm(observation[AGENT_POS][:3] - observation[ENVIRONMENT_STATE][-3:])
            assert info["is_success"] is bool(distance < 0.05)
            seen.add(info["is_success"])
    assert seen == {True, False}


def test_adroit_door_succeeds_when_it_is_open():
    env = GymnasiumRoboticsEnv(task="AdroitHandDoor-v1").make_single()
    _, info = env.reset(seed=0)
    assert info["is_success"] is False
    *_, info = env.step(np.zeros(28, dtype=np.float32))
    assert info["is_success"] is False
    raw = env.unwrapped
    state = raw.get_env_state()
    state["qpos"][raw.door_hinge_addrs] = 1.5
    raw.set_env_state(state)
    *_, info = env.step(np.zeros(28, dtype=np.float32))
    assert info["is_success"] is True


def test_adroit_ball_succeeds_at_the_target():
    env = GymnasiumRoboticsEnv(task="AdroitHandRelocate-v1").make_single()
    env.reset(seed=0)
    raw = env.unwrapped
    raw.model.site_pos[raw.target_obj_site_id] = raw.data.xpos[raw.obj_body_id]
    *_, info = env.step(np.zeros(30, dtype=np.float32))
    assert info["is_success"] is True


def test_kitchen_succeeds_when_every_task_has_been_done_once():
    from gymnasium_robotics.envs.franka_kitchen.kitchen_env import OBS_ELEMENT_GOALS, OBS_ELEMENT_INDICES

    assert set(KITCHEN_TASKS) == set(OBS_ELEMENT_GOALS)
    env = GymnasiumRoboticsEnv(task=KITCHEN, tasks_to_complete=["microwave", "light switch"]).make_single()
    assert env.task_description == "Kitchen: microwave, light switch."
    _, info = env.reset(seed=0)
    assert info["is_success"] is False
    data = env.unwrapped.data
    still = np.zeros(9, dtype=np.float32)

    def put(task: str, position: np.ndarray) -> bool:
        data.qpos[OBS_ELEMENT_INDICES[task]] = position
        _, _, terminated, _, info = env.step(still)
        assert terminated == info["is_success"]
        return info["is_success"]

    assert not put("microwave", OBS_ELEMENT_GOALS["microwave"])
    assert not put("microwave", np.zeros(1))  # shut again: it has been done
    assert put("light switch", OBS_ELEMENT_GOALS["light switch"])
    _, info = env.reset(seed=1)
    assert info["is_success"] is False
