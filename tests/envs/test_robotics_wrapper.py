"""Images of the Gymnasium-Robotics environments."""

import numpy as np
import pytest

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv

pytest.importorskip("gymnasium_robotics")

REACH = {"task": "FetchReach-v4", "observation_height": 40, "observation_width": 64}


@pytest.fixture
def make(rendering):
    """Builds environments and closes them in the end."""
    envs = []

    def build(**options):
        envs.append(GymnasiumRoboticsEnv(**{**REACH, **options}).make_single())
        return envs[-1]

    yield build
    for env in envs:
        env.close()


def test_no_renderer_is_opened_unless_asked_for():
    env = GymnasiumRoboticsEnv(**REACH).make_single()
    env.reset(seed=0)
    env.step(np.zeros(4, dtype=np.float32))
    assert not env.scene_renderer.renderers
    assert env.unwrapped.mujoco_renderer.viewer is None


def test_images_have_the_size_asked_for(make):
    env = make(obs_type="pixels", visualization_height=48, visualization_width=80)
    observation, _ = env.reset(seed=0)
    assert list(observation) == [PIXELS]
    assert observation[PIXELS].shape == (40, 64, 3) and observation[PIXELS].dtype == np.uint8
    assert observation[PIXELS].std() > 10
    assert env.render().shape == (48, 80, 3)


def test_images_larger_than_the_models_buffer(make):
    env = make(obs_type="pixels", observation_height=500, observation_width=700)
    assert env.reset(seed=0)[0][PIXELS].shape == (500, 700, 3)


def test_pixels_and_state_show_the_same_episode(make):
    pixels, state = make(obs_type="pixels_agent_pos"), make()
    seen, known = pixels.reset(seed=5)[0], state.reset(seed=5)[0]
    first = seen[PIXELS].copy()
    rng = np.random.default_rng(0)
    for _ in range(5):
        np.testing.assert_allclose(seen[AGENT_POS], known[AGENT_POS], atol=1e-6)
        np.testing.assert_allclose(pixels.state[ENVIRONMENT_STATE], known[ENVIRONMENT_STATE], atol=1e-6)
        action = rng.uniform(-1, 1, 4).astype(np.float32)
        seen, known = pixels.step(action)[0], state.step(action)[0]
    assert not np.array_equal(first, seen[PIXELS])


def test_the_goal_can_be_seen(make):
    """Otherwise no policy could reach it from pixels."""
    env = make()
    env.reset(seed=0)
    before = env.render()
    env.unwrapped.goal = env.unwrapped.goal + [0.0, 0.1, 0.1]
    after = env.render()
    assert not np.array_equal(before, after)


def test_two_environments_do_not_draw_into_each_others_images(make):
    first, second = make(obs_type="pixels"), make(obs_type="pixels")
    alone = first.reset(seed=1)[0][PIXELS].copy()
    second.reset(seed=2)
    np.testing.assert_array_equal(first.reset(seed=1)[0][PIXELS], alone)


@pytest.mark.slow
def test_shadows_can_be_left_out(make):
    bright = make(obs_type="pixels", task="AdroitHandDoor-v1", shadows=False).reset(seed=0)[0][PIXELS]
    dark = make(obs_type="pixels", task="AdroitHandDoor-v1").reset(seed=0)[0][PIXELS]
    assert bright.mean() > dark.mean()
