"""Images of the Gymnasium-Robotics environments."""

import numpy as np
import pytest

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.flag_checks import FlagError

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


def play(env, seed: int, n_steps: int = 12) -> np.ndarray:
    """States of an episode of random actions that push the block about."""
    rng, states = np.random.default_rng(seed), []
    env.reset(seed=seed)
    for _ in range(n_steps):
        env.step(np.array([*rng.uniform(-1, 1, 2), -1.0, 0.0], dtype=np.float32))
        states.append(np.concatenate(list(env.get_wrapper_attr("state").values())))
    return np.array(states)


def test_an_episode_does_not_depend_on_whether_it_is_looked_at(make):
    options = {"task": "FetchPickAndPlace-v4", "observation_height": 16, "observation_width": 16}
    seen = make(**options, obs_type="pixels_environment_state_agent_pos", cameras=["front", "side"])
    np.testing.assert_array_equal(play(seen, seed=5), play(make(**options), seed=5))


def test_the_goal_is_where_it_is_drawn_from_every_camera(make):
    """Red pixels move with the goal, also at the second image of a state."""
    env = make(
        task="FetchPickAndPlace-v4", obs_type="pixels", cameras=["front", "side"], observation_height=96
    )
    seen = []
    for goal in ([1.3, 0.65, 0.6], [1.3, 0.85, 0.6]):
        env.reset(seed=0)
        env.unwrapped.goal = np.array(goal)
        images = [env.observe(*env.spec_of_task.split(env.unwrapped._get_obs()))[PIXELS] for _ in range(2)]
        for name in ("front", "side"):
            np.testing.assert_array_equal(images[0][name], images[1][name])
        image = images[0]["front"].astype(int)
        red = (image[..., 0] > 120) & (image[..., 1] < 60) & (image[..., 2] < 60)
        assert red.sum() > 5
        seen.append(np.argwhere(red)[:, 1].mean())
    assert abs(seen[0] - seen[1]) > 10


# ---- masks and backgrounds ----

SHOWN = {"task": "FetchPickAndPlace-v4", "obs_type": "pixels_agent_pos", "cameras": ["front", "side"]}


def test_masks_are_white_where_nothing_can_move(make):
    env = make(**SHOWN, masks=True, observation_height=96, observation_width=96)
    observation, _ = env.reset(seed=0)
    image, mask = observation[PIXELS]["front"].astype(int), observation[PIXELS]["front_mask"]
    assert set(np.unique(mask)) == {0, 255} and 0.2 < (mask == 255).mean() < 0.95
    red = (image[..., 0] > 120) & (image[..., 1:] < 60).all(axis=-1)
    green = (image[..., 1] > 200) & (image[..., 0] < 130) & (image[..., 2] < 170)
    black = (image < 40).all(axis=-1)
    assert red.any() and not mask[red].any(), "the goal"
    assert black.any() and (mask[black] == 0).mean() > 0.5, "the block"
    assert green.any() and (mask[green] == 255).mean() > 0.99, "the wall"


def shown(**options) -> list[dict]:
    env = GymnasiumRoboticsEnv(**SHOWN, observation_height=48, observation_width=48, **options).build()
    observation, _ = env.reset(seed=3)
    following = env.step(np.zeros(4, dtype=np.float32))[0]
    another, _ = env.reset(seed=4)
    again, _ = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    env.close()
    return [observation, following, another, again]


def test_a_background_lasts_for_an_episode_and_follows_from_its_seed(rendering):
    plain, before = shown(masks=True), shown(background="noise")
    assert set(before[0][PIXELS]) == {"front", "side"}
    masks = [each[PIXELS]["front_mask"][..., 0] > 0 for each in plain]
    pictures = [each[PIXELS]["front"] for each in before]
    for picture, mask, original in zip(pictures, masks, plain, strict=True):
        np.testing.assert_array_equal(picture[~mask], original[PIXELS]["front"][~mask])
    both = masks[0] & masks[1]
    np.testing.assert_array_equal(pictures[0][both], pictures[1][both])
    both = masks[0] & masks[2]
    assert (pictures[0][both] != pictures[2][both]).mean() > 0.5
    np.testing.assert_array_equal(pictures[0], pictures[3])


@pytest.mark.parametrize("options", [{"masks": True}, {"background": "noise"}])
def test_masks_belong_to_named_cameras(options):
    (name,) = options
    with pytest.raises(FlagError, match=f"--env.{name}=.*--env.cameras"):
        GymnasiumRoboticsEnv(obs_type="pixels_agent_pos", **options)
    with pytest.raises(FlagError, match="--env.background=/nowhere must be one of noise"):
        GymnasiumRoboticsEnv(**SHOWN, background="/nowhere")
