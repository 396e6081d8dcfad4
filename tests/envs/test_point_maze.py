"""Mazes with several ways: the simulation, its experts and which way an episode took."""

import numpy as np
import pytest

from lerobot_agpd.cli.demos import DemosConfig
from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS
from lerobot_agpd.envs.experts.point_maze import EXPERTS
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.maze_tasks import TASKS
from lerobot_agpd.envs.point_maze import PointMazeWaysEnv
from lerobot_agpd.flag_checks import FlagError

pytest.importorskip("gymnasium_robotics")


def play(env, expert, seed: int) -> tuple[np.ndarray, bool]:
    """States (T, 4) of an episode, and whether it succeeded."""
    env.reset(seed=seed)
    states, done = [env.unwrapped.state[AGENT_POS]], False
    while not done:
        _, _, terminated, truncated, info = env.step(expert(env.unwrapped.state))
        states.append(env.unwrapped.state[AGENT_POS])
        done = terminated or truncated
    return np.stack(states), info["is_success"]


@pytest.mark.parametrize("task", TASKS)
def test_every_way_is_taken_and_read_off_the_states(task):
    env = PointMazeWaysEnv(task=task).make_single()
    n_ways = TASKS[task].n_ways
    for way in range(n_ways):
        expert = EXPERTS[task].with_ways(np.eye(n_ways)[way])
        for seed in range(3):
            states, success = play(env, expert.for_episode(np.random.default_rng(seed)), seed)
            assert success and TASKS[task].way_of(states, states[:, :0]) == way
            assert 20 <= len(states) <= 0.75 * TASKS[task].episode_length
            assert (
                TASKS[task].way_of(states[:-1], states[:-1, :0]) == way
            )  # as recorded: without the state at the exit


@pytest.mark.parametrize("task", TASKS)
def test_exits_and_start_are_where_pointmaze_has_them(task):
    from gymnasium_robotics.envs.maze.maze_v4 import Maze

    spec = TASKS[task]
    maze = Maze([list(row) for row in spec.maze], 1, 0.4)
    for name, points in (("g", spec.exits), ("r", [spec.start])):
        cells = [maze.cell_xy_to_rowcol(point) for point in points]
        assert [spec.maze[i][j] for i, j in cells] == [name] * len(cells)
        np.testing.assert_allclose([maze.cell_rowcol_to_xy(cell) for cell in cells], points)


def test_walls_stop_the_ball_and_standing_still_is_no_success():
    env = PointMazeWaysEnv(task="ThreeExits-v0").make_single()
    for action in ([0.0, -0.2], [0.0, 0.0]):  # into the wall between the southern exits; nothing
        expert = lambda observation, action=action: np.array(action, dtype=np.float32)  # noqa: E731
        states, success = play(env, expert, seed=0)
        assert not success and len(states) == TASKS["ThreeExits-v0"].episode_length + 1
        assert np.all(np.abs(states[:, 0]) <= 2.45) and states[-1, 1] >= -3.95


def test_median_of_the_three_exits_leads_into_a_dead_end():
    """And the mean to no exit: what a deterministic student of balanced demonstrations does."""
    spec = TASKS["ThreeExits-v0"]
    headings = np.stack([spec.waypoints(way)[0] - spec.start for way in range(3)])
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    np.testing.assert_allclose(headings.mean(axis=0), 0.0, atol=0.1)
    median = np.median(headings, axis=0)
    assert median[1] < -0.5 and abs(median[0]) < 1e-9

    env = PointMazeWaysEnv(task="ThreeExits-v0").make_single()
    states, success = play(env, lambda observation: (0.1 * median).astype(np.float32), seed=0)
    assert not success and states[-1, 1] == pytest.approx(-3.9, abs=0.05)


def test_a_seed_determines_the_episode():
    env, other = (PointMazeWaysEnv(task="Chain-v0").make_single() for _ in range(2))
    other.reset(seed=3)
    other.step(np.ones(2, dtype=np.float32))
    expert = EXPERTS["Chain-v0"]
    episodes = [play(e, expert.for_episode(np.random.default_rng(1)), seed=7)[0] for e in (env, other)]
    np.testing.assert_array_equal(*episodes)
    assert not np.array_equal(episodes[0][0], env.reset(seed=8)[0][AGENT_POS])


def test_observations_fit_the_declared_features():
    config = PointMazeWaysEnv(task="ThreeExits-v0")
    observation, info = config.make_single().reset(seed=0)
    shapes = {key: feature.shape for key, feature in config.features.items() if key != "action"}
    assert {key: value.shape for key, value in observation.items()} == shapes
    assert shapes == {AGENT_POS: (4,), ENVIRONMENT_STATE: (6,)} and info == {"is_success": False}
    exits = observation[ENVIRONMENT_STATE].reshape(3, 2) + observation[AGENT_POS][:2]
    np.testing.assert_allclose(exits, TASKS["ThreeExits-v0"].exits, atol=1e-6)


def test_images_show_the_ball(rendering):
    env = PointMazeWaysEnv(obs_type="pixels", observation_height=40, observation_width=64).make_single()
    first = env.reset(seed=0)[0][PIXELS].copy()
    assert first.shape == (40, 64, 3)
    for _ in range(10):
        last = env.step(np.array([0.0, 0.5], dtype=np.float32))[0][PIXELS]
    assert not np.array_equal(first, last)
    env.close()


def test_vector_environments_as_lerobot_builds_them():
    envs = PointMazeWaysEnv(task="TwoWays-v0").create_envs(2)["point_maze_ways"][0]
    envs.reset(seed=[0, 1])
    _, reward, *_ = envs.step(np.zeros((2, 2), dtype=np.float32))
    assert reward.shape == (2,) and envs.call("_max_episode_steps") == (100, 100)
    envs.close()


def test_fractions_of_the_ways(tmp_path):
    config = DemosConfig(tmp_path / "new", PointMazeWaysEnv(task="ThreeExits-v0"), ways=[0.0, 0.25, 0.75])
    spec = TASKS["ThreeExits-v0"]
    observation = {AGENT_POS: np.zeros(4)}
    ways = []
    for seed in range(200):
        force = config.make_expert().for_episode(np.random.default_rng([5, seed]))(observation)
        headings = [spec.waypoints(way)[0] @ force for way in range(3)]
        ways.append(int(np.argmax(headings)))
    np.testing.assert_allclose(np.bincount(ways, minlength=3) / len(ways), [0.0, 0.25, 0.75], atol=0.1)


@pytest.mark.parametrize("ways", [[0.5, 0.5], [0.5, 0.5, 0.5], [-0.5, 0.5, 1.0]])
def test_impossible_fractions_are_refused(ways, tmp_path):
    with pytest.raises(FlagError, match=r"--ways=\["):
        DemosConfig(tmp_path / "new", PointMazeWaysEnv(task="ThreeExits-v0"), ways=ways)


def test_ways_of_a_task_that_has_one_are_refused(tmp_path):
    with pytest.raises(FlagError, match="--ways=.*FetchReach-v4"):
        DemosConfig(tmp_path / "new", GymnasiumRoboticsEnv(task="FetchReach-v4"), ways=[1.0])
