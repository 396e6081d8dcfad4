"""Which way the kept episodes of every round took."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.maze_tasks import TASKS
from lerobot_agpd.envs.point_maze import PointMazeWaysEnv
from lerobot_agpd.replay.episode import Episode, EpisodeRecord, EpisodeSpec
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.studies.tables import ways_table
from lerobot_agpd.studies.ways import RoundWays, read_ways, ways_of_rounds

NORTH, WEST, EAST = (TASKS["ThreeExits-v0"].waypoints(way) for way in range(3))
META = SimpleNamespace(tasks=None, fps=10, robot_type=None, features={})


def append(journal, round_number, number, path, strength, kept=True, scene=True) -> None:
    """An episode along the points of a path."""
    state = np.hstack([path, np.zeros_like(path)]).astype(np.float32)
    observations = {"observation.state": state}
    if scene:
        observations["observation.environment_state"] = np.zeros((len(path), 6), dtype=np.float32)
    episode = Episode(
        spec=EpisodeSpec(number, number, strength),
        task="",
        observations=observations,
        actions=np.zeros((len(path), 2), dtype=np.float32),
        rewards=np.zeros(len(path), dtype=np.float32),
        successes=None,
    )
    facts = {"max_reward": 0.0, "is_success": kept, "success": kept, "solved_at_start": False, "kept": kept}
    journal.append(round_number, 0, episode, EpisodeRecord(number, number, strength, len(path), **facts))


@pytest.fixture
def journal(tmp_path) -> EpisodeJournal:
    journal = EpisodeJournal(tmp_path / "agpd")
    journal.begin(META, {})
    return journal


def test_kept_episodes_of_finished_rounds_are_counted_by_way_and_by_who_decided(journal):
    for number, (path, strength, kept) in enumerate(
        [(NORTH, 0.5, True), (EAST, 0.5, True), (EAST, 0.5, True), (WEST, 0.0, True), (WEST, 0.5, False)]
    ):
        append(journal, 0, number, path, strength, kept)
    append(journal, 1, 0, EAST, 0.5)
    append(journal, 2, 0, EAST, 0.5)  # not finished
    for number in (0, 1):
        journal.finish(number, {})
    rounds = ways_of_rounds(journal.root, PointMazeWaysEnv(task="ThreeExits-v0"))
    assert rounds == [RoundWays([1, 0, 2], [0, 1, 0]), RoundWays([0, 0, 1], [0, 0, 0])]
    assert rounds[0].total == [1, 1, 2] and rounds[1].entropy == 0.0
    assert rounds[0].entropy == pytest.approx(0.5 * math.log(2) + 2 * 0.25 * math.log(4))
    assert read_ways(json.loads(json.dumps([entry.to_json() for entry in rounds]))) == rounds


def test_a_round_without_kept_episodes_has_no_entropy():
    assert math.isnan(RoundWays([0, 0], [0, 0]).entropy)


def test_nothing_is_said_of_a_task_with_one_way_or_of_episodes_that_do_not_show_it(journal):
    append(journal, 0, 0, EAST, 0.5, scene=False)
    journal.finish(0, {})
    assert ways_of_rounds(journal.root, PointMazeWaysEnv(task="ThreeExits-v0")) == []
    assert ways_of_rounds(journal.root, GymnasiumRoboticsEnv(task="FetchReach-v4")) == []


def test_a_row_per_training_seed():
    run = lambda seed, *ways: SimpleNamespace(run=SimpleNamespace(seed=seed), ways=ways)  # noqa: E731
    one, two = RoundWays([1, 1], [0, 0]), RoundWays([0, 3], [0, 1])
    rows = ways_table({"bc": [run(1)], "agpd": [run(1, one, two), run(2, two)]})
    assert rows == [
        ("", "round 0", "round 1"),
        ("agpd, 1", "1 1 (0.69)", "0 4 (0.00)"),
        ("agpd, 2", "0 4 (0.00)", ""),
    ]
    assert ways_table({"bc": [run(1)]}) == []
