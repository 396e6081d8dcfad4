"""robomimic's tasks in robosuite: what is observed, seeds, success, states and images."""

import logging
from xml.etree import ElementTree

import gymnasium as gym
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS, View
from lerobot_agpd.envs.robomimic_tasks import TASKS

pytest.importorskip("robosuite")

from lerobot_agpd.envs.robosuite_sim import RobosuiteEnv  # noqa: E402

ALL_TASKS = [pytest.param(t, marks=() if t == "lift" else pytest.mark.slow) for t in TASKS]


@pytest.fixture(scope="module")
def make():
    """Builds every environment once and closes them in the end."""
    envs: dict[str, RobosuiteEnv] = {}

    def build(task: str) -> RobosuiteEnv:
        if task not in envs:
            envs[task] = RobosuiteEnv(task)
        return envs[task]

    yield build
    for env in envs.values():
        env.close()


def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([observation[AGENT_POS], observation[ENVIRONMENT_STATE]])


def continued(env: RobosuiteEnv, first: dict[str, np.ndarray], seed: int, n_steps: int = 8) -> np.ndarray:
    """Observations (n_steps + 1, D) under random actions that depend on the seed only."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (n_steps, *env.action_space.shape))
    return np.stack([flat(first), *(flat(env.step(action.astype(np.float32))[0]) for action in actions)])


def roll(env: RobosuiteEnv, seed: int) -> np.ndarray:
    return continued(env, env.reset(seed=seed)[0], seed)


@pytest.mark.parametrize("task", ALL_TASKS)
def test_keys_and_cameras_are_robosuites(task, make):
    env = make(task)
    env.reset(seed=0)
    spec, simulation = TASKS[task], env.simulation
    observables = simulation._observables.items()
    objects = tuple(name for name, item in observables if item.modality == "object" and item.is_active())
    assert objects == spec.object_keys
    model = simulation.sim.model
    assert {model.camera_id2name(camera) for camera in range(model.ncam)} == {
        *spec.cameras,
        *spec.more_cameras,
    }
    assert env.simulation.action_dim == spec.action_dim


def test_lift_observes_hand_and_cube(make):
    env = make("lift")
    observation, _ = env.reset(seed=3)
    data = env.simulation.sim.data
    cube = data.body_xpos[env.simulation.cube_body_id]
    hand = data.site_xpos[env.simulation.robots[0].eef_site_id["right"]]
    np.testing.assert_allclose(observation[AGENT_POS][:3], hand, atol=1e-6)
    np.testing.assert_allclose(observation[ENVIRONMENT_STATE][:3], cube, atol=1e-6)
    np.testing.assert_allclose(observation[ENVIRONMENT_STATE][7:], cube - hand, atol=1e-6)
    fingers = observation[AGENT_POS][7:]
    assert fingers[0] == pytest.approx(-fingers[1]) and 0.03 < fingers[0] - fingers[1] < 0.05


def test_first_relative_pose_is_known(make):
    """Robosuite's own first observation has zeros there."""
    observation, _ = make("can").reset(seed=0)
    relative = observation[ENVIRONMENT_STATE][:3]
    world = observation[ENVIRONMENT_STATE][7:10] - observation[AGENT_POS][:3]
    assert np.linalg.norm(relative) == pytest.approx(np.linalg.norm(world), rel=1e-4)


def test_relative_pose_is_one_step_late_as_in_robomimics_data(make):
    env = make("can")
    observation, _ = env.reset(seed=0)
    state = env.get_state()
    can = np.flatnonzero(np.isclose(state, observation[ENVIRONMENT_STATE][9], atol=1e-6))
    state[can] += 0.3  # it falls
    observation, _ = env.reset_to(state)
    for _ in range(4):
        before = observation[ENVIRONMENT_STATE][7:10]
        observation, *_ = env.step(np.array([1, 1, 0, 0, 0, 0, -1], dtype=np.float32))
        grip, hand = observation[AGENT_POS][:3], Rotation.from_quat(observation[AGENT_POS][3:7])
        np.testing.assert_allclose(
            observation[ENVIRONMENT_STATE][:3], hand.inv().apply(before - grip), atol=1e-5
        )
        assert before[2] - observation[ENVIRONMENT_STATE][9] > 0.003


@pytest.mark.parametrize("task", ALL_TASKS)
def test_seed_determines_the_episode_also_in_a_used_env(task, make):
    used, fresh = make(task), RobosuiteEnv(task)
    first, other, again = roll(used, 1), roll(used, 2), roll(used, 1)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, roll(fresh, 1))
    assert not np.array_equal(first[0], other[0])
    fresh.close()


def test_later_episodes_follow_from_the_seed_too(make):
    env = make("lift")
    pairs = []
    for _ in range(2):
        pairs.append(np.stack([flat(env.reset(seed=4)[0]), flat(env.reset()[0])]))
    np.testing.assert_array_equal(*pairs)
    assert not np.array_equal(*pairs[0])


def test_numpys_global_generator_is_left_alone(make):
    np.random.seed(11)
    expected = np.random.random(3)
    np.random.seed(11)
    RobosuiteEnv("lift").close()
    roll(make("lift"), 0)
    np.testing.assert_array_equal(np.random.random(3), expected)


@pytest.mark.parametrize("task", ALL_TASKS)
def test_an_episode_replays_from_its_first_state(task, make):
    env = make(task)
    env.reset(seed=6)
    state = env.get_state()
    played = continued(env, env.reset(seed=6)[0], seed=0)
    roll(env, 7)
    observation, info = env.reset_to(state)
    assert info["is_success"] is False
    np.testing.assert_array_equal(env.get_state()[1:], state[1:])
    np.testing.assert_array_equal(continued(env, observation, seed=0), played)


def test_a_recorded_model_lasts_until_the_next_reset(make):
    env = make("lift")
    start = roll(env, 5)
    env.reset(seed=8)
    cube = env.simulation.sim.model.geom_name2id("cube_g0")
    size = env.simulation.sim.model.geom_size[cube].copy()
    root = ElementTree.fromstring(
        env.simulation.model.get_xml()
    )  # the simulator's is the last of the process
    (geom,) = root.iterfind(".//geom[@name='cube_g0']")
    geom.set("size", "0.03 0.03 0.03")
    env.reset_to(env.get_state(), ElementTree.tostring(root, encoding="unicode"))
    np.testing.assert_allclose(env.simulation.sim.model.geom_size[cube], 0.03)
    np.testing.assert_array_equal(roll(env, 5), start)
    np.testing.assert_array_equal(env.simulation.sim.model.geom_size[cube], size)


def test_a_state_of_another_task_is_refused(make):
    with pytest.raises(ValueError, match=r"lift has the shape \(32,\), got \(71,\)"):
        make("lift").reset_to(np.zeros(71))


def test_a_cube_in_the_air_is_a_success_and_ends_the_episode(make):
    env = make("lift")
    env.reset(seed=0)
    state = env.get_state()
    height = int(np.argmin(np.abs(state - env.state[ENVIRONMENT_STATE][2])))  # of the cube
    state[height] = 0.95
    _, info = env.reset_to(state)
    assert info["is_success"] is True
    _, reward, terminated, truncated, info = env.step(np.zeros(7, dtype=np.float32))
    assert (reward, terminated, truncated, info["is_success"]) == (1.0, True, False, True)
    _, info = env.reset(seed=0)
    assert info["is_success"] is False


def test_an_action_of_one_moves_the_hand_along_the_worlds_axis(make):
    env = make("lift")
    for axis in range(3):
        start = env.reset(seed=0)[0][AGENT_POS][:3]
        action = np.zeros(7, dtype=np.float32)
        action[axis] = 1.0
        for _ in range(5):
            observation, *_ = env.step(action)
        moved = observation[AGENT_POS][:3] - start
        assert int(np.argmax(np.abs(moved))) == axis and 0.03 < moved[axis] < 0.25


def test_gripper_closes_at_one(make):
    env = make("lift")
    widths = {}
    for command in (-1.0, 1.0):
        env.reset(seed=0)
        for _ in range(10):
            observation, *_ = env.step(np.array([0, 0, 0, 0, 0, 0, command], dtype=np.float32))
        widths[command] = observation[AGENT_POS][7] - observation[AGENT_POS][8]
    assert widths[-1.0] > 0.07 and widths[1.0] < 0.01


def test_states_are_seen_whatever_is_observed_and_no_renderer_is_opened_for_them(make):
    env = make("lift")
    roll(env, 0)
    assert set(env.state) == {AGENT_POS, ENVIRONMENT_STATE}
    assert not env.scene_renderer.renderers
    assert env.simulation.sim._render_context_offscreen is None


def test_robosuites_warnings_are_silenced_but_not_its_errors(caplog):
    logger = logging.getLogger("robosuite_logs")
    with caplog.at_level(logging.DEBUG, logger="robosuite_logs"):
        logger.warning("no private macro file")
        logger.error("something is wrong")
    assert [record.message for record in caplog.records] == ["something is wrong"]


@pytest.mark.slow
def test_images_are_robosuites_turned_the_right_way_up(rendering):
    from robosuite.utils.binding_utils import MjRenderContextOffscreen

    view = View((AGENT_POS, PIXELS), ("agentview", "robot0_eye_in_hand"), (40, 56), (48, 64))
    env = RobosuiteEnv("lift", view)
    observation, _ = env.reset(seed=1)
    assert list(observation) == [AGENT_POS, PIXELS]
    images = observation[PIXELS]
    assert all(image.shape == (40, 56, 3) and image.dtype == np.uint8 for image in images.values())
    assert env.observation_space.contains(observation)
    assert set(env.state) == {AGENT_POS, ENVIRONMENT_STATE}
    assert env.render().shape == (48, 64, 3)
    context = MjRenderContextOffscreen(env.simulation.sim, device_id=-1)
    context.vopt.geomgroup[0] = 0
    reference = env.simulation.sim.render(height=40, width=56, camera_name="agentview")[::-1]
    np.testing.assert_array_equal(images["agentview"], reference)
    sky_above, table_below = images["agentview"][:4].mean(), images["agentview"][-4:].mean()
    assert table_below > sky_above  # the white table lies below the dark robot
    env.close()


@pytest.mark.slow
def test_space_of_the_images():
    env = RobosuiteEnv("lift", View((PIXELS,), ("sideview",), (24, 32)))
    assert isinstance(env.observation_space[PIXELS], gym.spaces.Dict)
    assert env.observation_space[PIXELS]["sideview"].shape == (24, 32, 3)
    env.close()
