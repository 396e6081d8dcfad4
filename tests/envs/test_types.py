"""What every environment type has in common, as LeRobot's own commands use it."""

import pickle
import sys
import warnings
from dataclasses import dataclass

import draccus
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from lerobot.envs import EnvConfig, make_env, preprocess_observation
from lerobot.envs.utils import check_env_attributes_and_types, env_to_policy_features
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_agpd.envs import (
    aloha,
    fetch_ways,
    gymnasium_robotics,
    point_maze,
    pusht,
    robomimic,
    robosuite_ways,
)
from lerobot_agpd.envs.aloha import AlohaStateEnvConfig
from lerobot_agpd.envs.base import ENVIRONMENT_STATE
from lerobot_agpd.envs.fetch_ways import FetchWaysEnv
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.point_maze import PointMazeWaysEnv
from lerobot_agpd.envs.pusht import PushTStateEnvConfig
from lerobot_agpd.envs.robomimic import RobomimicEnvConfig
from lerobot_agpd.envs.robosuite_ways import RobosuiteWaysEnv
from lerobot_agpd.flag_checks import FlagError

KITCHEN = "FrankaKitchen-v1"
EVERYTHING = "pixels_environment_state_agent_pos"
MODULES = {
    AlohaStateEnvConfig: (aloha, "gym_aloha", "aloha"),
    FetchWaysEnv: (fetch_ways, "gymnasium_robotics", "fetch"),
    GymnasiumRoboticsEnv: (gymnasium_robotics, "gymnasium_robotics", "fetch"),
    PointMazeWaysEnv: (point_maze, "gymnasium_robotics", "fetch"),
    PushTStateEnvConfig: (pusht, "gym_pusht", "pusht"),
    RobomimicEnvConfig: (robomimic, "robosuite", "robomimic"),
    RobosuiteWaysEnv: (robosuite_ways, "robosuite", "robomimic"),
}
"""Type to its module, the package of its simulation and the extra that installs it."""

QUICK = [
    (AlohaStateEnvConfig, "AlohaTransferCube-v0"),
    (AlohaStateEnvConfig, "AlohaInsertion-v0"),
    (PushTStateEnvConfig, "PushT-v0"),
    *((FetchWaysEnv, task) for task in fetch_ways.TASKS),
    *((GymnasiumRoboticsEnv, task) for task in gymnasium_robotics.TASKS),
    *((PointMazeWaysEnv, task) for task in point_maze.TASKS),
    (RobosuiteWaysEnv, "LiftAny-v0"),
    (RobomimicEnvConfig, "lift"),
]
SLOW = [(RobomimicEnvConfig, task) for task in robomimic.TASKS if task != "lift"]

every_type = pytest.mark.parametrize("kind", MODULES)


@dataclass
class Command:
    """Options of a command with an environment, such as `lerobot-eval`."""

    env: EnvConfig


def make_vector_env(config: EnvConfig, n_envs: int = 2, use_async_envs: bool = False):
    pytest.importorskip(MODULES[type(config)][1])
    return make_env(config, n_envs=n_envs, use_async_envs=use_async_envs)[config.type][0]


def check(config: EnvConfig) -> None:
    (env,) = make_vector_env(config, n_envs=1).envs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # unbounded observations, and being wrapped at all
        check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.parametrize(
    ("kind", "task"), [*QUICK, *(pytest.param(*each, marks=pytest.mark.slow) for each in SLOW)]
)
def test_gymnasium_env_checker_accepts_it(kind, task):
    check(kind(task=task))


@pytest.mark.slow
@every_type
def test_gymnasium_env_checker_accepts_pixels(rendering, kind):
    check(kind(obs_type="pixels_agent_pos", observation_height=24, observation_width=32, shadows=False))


@pytest.mark.parametrize(
    ("kind", "task"),
    [
        QUICK[0],
        QUICK[-1],
        (FetchWaysEnv, "PickAnyBlock-v0"),
        (PointMazeWaysEnv, "Chain-v0"),
        *((GymnasiumRoboticsEnv, t) for t in ("FetchPush-v4", KITCHEN)),
    ],
)
@pytest.mark.parametrize("use_async_envs", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_vector_env_agrees_with_the_declared_features(use_async_envs, kind, task):
    config = kind(task=task, episode_length=2)
    env = make_vector_env(config, use_async_envs=use_async_envs)
    try:
        assert type(env) is (AsyncVectorEnv if use_async_envs else SyncVectorEnv)
        assert env.call("_max_episode_steps") == (2, 2)
        assert all(env.call("task_description"))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env_attributes_and_types(env)

        observation, info = env.reset(seed=[5, 6])
        assert info["is_success"].dtype == bool
        features = env_to_policy_features(config)
        batch = preprocess_observation(observation)
        assert {key: tuple(value.shape[1:]) for key, value in batch.items()} == {
            key: features[key].shape for key in (OBS_STATE, OBS_ENV_STATE)
        }
        assert env.single_action_space.shape == features[ACTION].shape

        for step in range(2):
            _, _, _, truncated, info = env.step(0.5 * (env.action_space.low + env.action_space.high))
            ended = info["final_info"] if step == 1 else info
            assert ended["is_success"].dtype == bool and ended["is_success"].shape == (2,)
            assert truncated.tolist() == [step == 1] * 2

        # The same seeds give what a single environment gives: workers are not seeded in some other way.
        observation, _ = env.reset(seed=[5, 6])
        single = config.make_single()
        expected, _ = single.reset(seed=6)
        np.testing.assert_array_equal(observation[ENVIRONMENT_STATE][1], expected[ENVIRONMENT_STATE])
        single.close()
    finally:
        env.close()


@pytest.mark.parametrize(
    ("kind", "options", "expected"),
    [
        (AlohaStateEnvConfig, ["task=AlohaInsertion-v0", "cameras=[angle]"], {"cameras": ["angle"], "fps": 50}),
        (FetchWaysEnv, ["task=PushEitherSide-v0"], {"episode_length": 60, "fps": 25}),
        (GymnasiumRoboticsEnv, ["task=FetchPush-v4", "episode_length=7"], {"episode_length": 7, "fps": 25}),
        (GymnasiumRoboticsEnv, [f"task={KITCHEN}", "tasks_to_complete=[kettle]"], {"tasks_to_complete": ["kettle"]}),
        (PointMazeWaysEnv, ["task=Chain-v0", "obs_type=pixels"], {"episode_length": 130, "fps": 10}),
        (RobomimicEnvConfig, ["task=tool_hang", "obs_type=pixels"], {"episode_length": 700, "fps": 20}),
        (RobosuiteWaysEnv, ["episode_length=30", "obs_type=pixels"], {"episode_length": 30, "fps": 20}),
        (RobomimicEnvConfig, ["cameras=[frontview]", "obs_type=pixels"], {"cameras": ["frontview"]}),
    ],
)  # fmt: skip
def test_command_line_and_round_trip(kind, options, expected):
    flags = [f"--env.type={EnvConfig.get_choice_name(kind)}", *(f"--env.{option}" for option in options)]
    config = draccus.parse(Command, args=flags).env
    assert isinstance(config, kind) and {key: getattr(config, key) for key in expected} == expected
    assert draccus.decode(EnvConfig, draccus.encode(config, EnvConfig)) == config
    assert pickle.loads(pickle.dumps(config)) == config


@pytest.mark.parametrize(
    ("config", "episode_length", "cameras"),
    [
        (AlohaStateEnvConfig(), 400, ["top"]),
        (FetchWaysEnv(), 32, []),
        (GymnasiumRoboticsEnv(), 50, []),
        (GymnasiumRoboticsEnv(task=KITCHEN), 280, []),
        (PointMazeWaysEnv(), 80, []),
        (RobosuiteWaysEnv(), 40, []),
        (RobomimicEnvConfig(), 400, ["agentview", "robot0_eye_in_hand"]),
        (
            RobomimicEnvConfig(task="transport"),
            700,
            ["shouldercamera0", "shouldercamera1", "robot0_eye_in_hand", "robot1_eye_in_hand"],
        ),
    ],
)
def test_defaults_follow_the_task(config, episode_length, cameras):
    assert (config.episode_length, list(config.observed_cameras)) == (episode_length, cameras)
    pixels = type(config)(task=config.task, obs_type="pixels_agent_pos", observation_height=24)
    features = env_to_policy_features(pixels)
    images = [f"observation.images.{camera}" for camera in cameras] or ["observation.image"]
    assert set(features) == {ACTION, OBS_STATE, *images}
    assert all(features[key].shape == (3, 24, pixels.observation_width) for key in images)


@pytest.mark.parametrize(
    "config",
    [
        GymnasiumRoboticsEnv(obs_type=EVERYTHING, cameras=["front", "side"], antialiasing=False),
        FetchWaysEnv(obs_type=EVERYTHING),
        PushTStateEnvConfig(obs_type=EVERYTHING),
        *(
            pytest.param(
                kind(obs_type=EVERYTHING, observation_height=24, shadows=False), marks=pytest.mark.slow
            )
            for kind in (AlohaStateEnvConfig, PointMazeWaysEnv, RobomimicEnvConfig, RobosuiteWaysEnv)
        ),
    ],
    ids=lambda config: config.type,
)
def test_cameras_and_environment_state_at_once(rendering, config):
    env = make_vector_env(config, n_envs=1)
    observation, _ = env.reset(seed=[3])
    batch, features = preprocess_observation(observation), env_to_policy_features(config)
    assert {key: tuple(value.shape[1:]) for key, value in batch.items()} == {
        key: feature.shape for key, feature in features.items() if key != ACTION
    }
    images = [key for key, value in batch.items() if value.ndim == 4]
    assert images and all(batch[key].std() > 0.01 for key in images)
    env.close()
    # What cameras see changes nothing in the state.
    blind = "environment_state_agent_pos" if "state" not in config.obs_types else "state"
    env = make_vector_env(type(config)(task=config.task, obs_type=blind), n_envs=1)
    expected, _ = env.reset(seed=[3])
    np.testing.assert_array_equal(observation[ENVIRONMENT_STATE], expected[ENVIRONMENT_STATE])
    env.close()


@every_type
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "laundry"}, "--env.task=laundry"),
        ({"task": None}, "--env.task=None"),
        ({"obs_type": "smell"}, "--env.obs_type=smell .*pixels_agent_pos"),
        ({"render_mode": "human"}, "--env.render_mode=human"),
        ({"fps": 31}, "--env.fps=31"),
        ({"episode_length": 0}, "--env.episode_length=0"),
        ({"observation_width": 0}, "--env.observation_width=0"),
        ({"observation_height": 3}, "--env.observation_height=3"),
    ],
)
def test_what_no_type_can_do_is_refused(kind, options, message):
    with pytest.raises(FlagError, match=message):
        kind(**options)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (AlohaStateEnvConfig, {"obs_type": "state"}, "--env.obs_type=state .*environment_state_agent_pos"),
        (PushTStateEnvConfig, {"obs_type": "state"}, "--env.obs_type=state .*environment_state_agent_pos"),
        (AlohaStateEnvConfig, {"cameras": ["behind"]}, "--env.cameras=.*behind.* top"),
        (AlohaStateEnvConfig, {"cameras": []}, "--env.cameras="),
        (RobomimicEnvConfig, {"cameras": ["shouldercamera0"]}, "--env.cameras=.*shouldercamera0.* agentview"),
        (RobomimicEnvConfig, {"cameras": []}, "--env.cameras="),
        (FetchWaysEnv, {"cameras": ["top"]}, "--env.cameras=.*top.* front"),
        (GymnasiumRoboticsEnv, {"task": KITCHEN, "cameras": ["front"]}, "--env.cameras=.*FrankaKitchen-v1"),
        (GymnasiumRoboticsEnv, {"task": KITCHEN, "camera_distance": 1.0}, "--env.camera_.*FrankaKitchen-v1 is fixed"),
        (GymnasiumRoboticsEnv, {"camera_distance": 0.0}, "--env.camera_distance must be positive"),
        (GymnasiumRoboticsEnv, {"camera_lookat": [1.0, 2.0]}, "--env.camera_lookat=.*three numbers"),
        (GymnasiumRoboticsEnv, {"tasks_to_complete": ["kettle"]}, "--env.tasks_to_complete=.*FetchPickAndPlace-v4"),
        (GymnasiumRoboticsEnv, {"task": KITCHEN, "tasks_to_complete": ["iron"]}, "iron.*bottom burner"),
        (GymnasiumRoboticsEnv, {"task": KITCHEN, "tasks_to_complete": []}, "--env.tasks_to_complete="),
    ],
)  # fmt: skip
def test_what_one_type_cannot_do_is_refused(kind, options, message):
    with pytest.raises(FlagError, match=message):
        kind(**options)


@every_type
def test_choices_are_checked_wherever_they_come_from(kind, capsys):
    name = EnvConfig.get_choice_name(kind)
    with pytest.raises(FlagError, match="--env.obs_type=smell.*pixels_agent_pos"):
        draccus.parse(Command, args=[f"--env.type={name}", "--env.obs_type=smell"])
    with pytest.raises(FlagError, match="smell.*pixels_agent_pos"):
        draccus.decode(EnvConfig, {"type": name, "obs_type": "smell"})
    with pytest.raises(SystemExit):
        draccus.parse(Command, args=[f"--env.type={name}", "--help"])
    text = capsys.readouterr().out
    assert "What is observed: " in text


@every_type
def test_missing_package_names_the_extra(monkeypatch, kind):
    _, package, extra = MODULES[kind]
    pytest.importorskip(package)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModuleNotFoundError, match=rf"pip install 'lerobot_policy_agpd\[{extra}\]'"):
        make_env(kind(), n_envs=2)
