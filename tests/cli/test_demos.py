"""`lerobot-agpd-demos`, end to end on FetchReach."""

import json
import sys

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig, PushtEnv
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_agpd.cli import demos
from lerobot_agpd.cli.demos import DemosConfig, record_demos, report_table
from lerobot_agpd.dataset_writer import DatasetWriter
from lerobot_agpd.envs.demonstrations import DemosReport, successful_episodes
from lerobot_agpd.envs.experts.base import Expert
from lerobot_agpd.envs.experts.fetch import fetch_reach_expert
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.robomimic import RobomimicEnvConfig
from lerobot_agpd.envs.robotics_tasks import TASKS
from lerobot_agpd.flag_checks import FlagError

pytest.importorskip("gymnasium_robotics")

REACH = "FetchReach-v4"


def reach_config(root, **options) -> DemosConfig:
    return DemosConfig(root=root, env=GymnasiumRoboticsEnv(task=REACH, episode_length=12), **options)


def lazy_expert(observation):
    return np.zeros(4, dtype=np.float32)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> LeRobotDataset:
    """Two episodes, recorded through the console command."""
    root = tmp_path_factory.mktemp("demos") / "nested" / "reach"
    argv = [
        "lerobot-agpd-demos",
        "--env.type=gymnasium_robotics",
        f"--env.task={REACH}",
        "--env.episode_length=12",
    ]
    argv += ["--episodes=2", "--seed=40", f"--root={root}", "--repo_id=local/reach", "--push_to_hub=false"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", argv)
        demos.main()
    return LeRobotDataset("local/reach", root=root)


def test_dataset_has_the_declared_contents(recorded):
    assert (recorded.num_episodes, recorded.num_frames, recorded.fps) == (2, 24, 25)
    assert not list(recorded.root.parent.glob("*.partial"))
    frame = recorded[11]
    shapes = {
        key: tuple(frame[key].shape)
        for key in ("observation.state", "observation.environment_state", "action")
    }
    assert shapes == {"observation.state": (10,), "observation.environment_state": (3,), "action": (4,)}
    assert frame["next.success"].item() and frame["next.done"].item() and frame["next.reward"].item() == 0
    assert frame["task"] == TASKS[REACH].description
    assert [recorded[i]["next.done"].item() for i in range(24)] == ([False] * 11 + [True]) * 2
    assert recorded[0]["next.reward"].item() == -1 and not recorded[0]["next.success"].item()


def assert_replay_repeats(dataset: LeRobotDataset, episode_length: int) -> None:
    """Play the recorded actions from the recorded seeds and compare everything that the environment delivers."""
    seeds = json.loads((dataset.root / demos.REPORT_PATH).read_text())["seeds"]
    assert len(seeds) == dataset.num_episodes
    frames = [dataset[i] for i in range(dataset.num_frames)]
    env = GymnasiumRoboticsEnv(task=REACH, episode_length=episode_length).make_single()
    for episode, seed in enumerate(seeds):
        observation, _ = env.reset(seed=seed)
        for frame in (frame for frame in frames if frame["episode_index"] == episode):
            np.testing.assert_array_equal(observation["agent_pos"], frame["observation.state"])
            np.testing.assert_array_equal(
                observation["environment_state"], frame["observation.environment_state"]
            )
            observation, reward, terminated, truncated, info = env.step(frame["action"].numpy())
            assert info["is_success"] == frame["next.success"].item()
            assert reward == frame["next.reward"].item()
            assert (terminated or truncated) == frame["next.done"].item()
        assert info["is_success"]


def test_replayed_actions_repeat_the_episode(recorded):
    assert json.loads((recorded.root / demos.REPORT_PATH).read_text())["seeds"][0] >= 40
    assert_replay_repeats(recorded, episode_length=12)


def test_the_expert_alone_needs_no_skill_column(recorded):
    assert "skill" not in recorded.features


@pytest.fixture(scope="module")
def mixture(tmp_path_factory) -> LeRobotDataset:
    """Five episodes of two operators in turn, recorded through the console command."""
    root = tmp_path_factory.mktemp("mixture") / "reach"
    argv = ["lerobot-agpd-demos", f"--env.task={REACH}", "--env.type=gymnasium_robotics"]
    argv += ["--env.episode_length=30", "--episodes=5", "--skill=[1,0.25]", f"--root={root}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", argv)
        demos.main()
    return LeRobotDataset("local/demos", root=root)


def test_operators_take_turns_and_their_skill_is_recorded(mixture):
    assert mixture.num_episodes == 5
    by_episode = {int(mixture[i]["episode_index"]): mixture[i]["skill"].item() for i in range(0, 150, 10)}
    assert by_episode == {0: 1.0, 1: 0.25, 2: 1.0, 3: 0.25, 4: 1.0}
    assert json.loads((mixture.root / demos.REPORT_PATH).read_text())["skills"] == [1.0, 0.25, 1.0, 0.25, 1.0]


def test_no_policy_reads_the_skill(mixture):
    assert "skill" not in dataset_to_policy_features(mixture.meta.features)


def test_replayed_actions_repeat_episodes_of_any_skill(mixture):
    assert_replay_repeats(mixture, episode_length=30)


def test_less_skill_means_longer_ways(mixture):
    frames = [mixture[i] for i in range(mixture.num_frames)]

    def wobble(skill: float) -> float:
        actions = np.stack([f["action"].numpy() for f in frames if f["skill"].item() == skill])
        return float(np.abs(np.diff(actions, axis=0)).mean())

    assert wobble(0.25) > 2 * wobble(1.0)


@pytest.mark.slow
def test_images_are_recorded_where_they_are_observed(rendering, tmp_path):
    env = GymnasiumRoboticsEnv(
        task=REACH,
        episode_length=12,
        obs_type="pixels_agent_pos",
        observation_height=24,
        observation_width=32,
    )
    record_demos(DemosConfig(root=tmp_path / "x", env=env, episodes=1))
    dataset = LeRobotDataset("local/demos", root=tmp_path / "x")
    assert dataset.num_frames == 12
    assert dataset[0]["observation.image"].shape == (3, 24, 32)
    assert "observation.environment_state" not in dataset.features


def test_report_counts_per_skill():
    report = DemosReport(task=REACH, seeds=[0, 1, 2], skills=[1.0, 0.5, 1.0])
    report.failed_seeds, report.failed_skills = [3, 4, 5], [0.5, 0.5, 0.5]
    cells = [cell for column in report_table(report).columns for cell in column.cells]
    assert (
        "0.25 [0.05, 0.70], N = 4" in cells
    )  # Wilson, by hand: (1 + z^2 / 2 -+ z sqrt(3 / 4 + z^2 / 4)) / (4 + z^2)


def test_rates_leave_starts_at_the_goal_out_or_count_them():
    report = DemosReport(task=REACH, seeds=[0, 1, 2], solved_at_start_seeds=[3, 4], failed_seeds=[5])
    report.skills, report.failed_skills = [1.0] * 3, [1.0]
    cells = [cell for column in report_table(report).columns for cell in column.cells]
    assert cells.count("0.75 [0.30, 0.95], N = 4") == 1
    assert cells.count("0.50 [0.19, 0.81], N = 6") == 1


def test_starts_at_the_goal_and_failures_are_left_out_and_counted(tmp_path):
    config = reach_config(tmp_path / "x", episodes=12)
    env = config.env.make_single()
    solved = [seed for seed in range(60) if env.reset(seed=seed)[1]["is_success"]]
    assert solved, "choose a range of seeds with a start at the goal"

    calls = 0

    def expert_that_fails_its_first_episode(observation):
        nonlocal calls
        calls += 1
        return (lazy_expert if calls <= 12 else fetch_reach_expert)(observation)

    report = DemosReport(task=REACH)
    expert = Expert(expert_that_fails_its_first_episode)
    episodes = successful_episodes(env, expert, config.env.features_map, [1.0], 12, config.seeds, report)
    assert len(list(episodes)) == len(report.seeds) == 12
    assert report.solved_at_start_seeds == [seed for seed in solved if seed <= report.seeds[-1]]
    assert report.failed_seeds == [next(seed for seed in range(60) if seed not in solved)]
    seeds = report.seeds + report.solved_at_start_seeds + report.failed_seeds
    assert sorted(seeds) == list(range(report.attempts))


def test_an_expert_that_never_succeeds_ends_in_an_error_and_leaves_no_dataset(tmp_path, monkeypatch):
    monkeypatch.setattr(demos, "make_expert", lambda env: Expert(lazy_expert))
    with pytest.raises(RuntimeError, match="Only 0 of 1 episodes succeeded in 10 attempts"):
        record_demos(reach_config(tmp_path / "x", episodes=1))
    assert not list(tmp_path.iterdir())


def test_leftovers_of_an_interrupted_run_are_replaced(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", lambda *args, **kwargs: None)  # as if it was killed
        patch.setattr(DatasetWriter, "_merged", lambda *args: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            record_demos(reach_config(tmp_path / "x", episodes=1))
    assert (tmp_path / "x.partial").exists() and not (tmp_path / "x").exists()
    record_demos(reach_config(tmp_path / "x", episodes=1))
    assert not (tmp_path / "x.partial").exists()
    assert LeRobotDataset("local/demos", root=tmp_path / "x").num_episodes == 1


@pytest.mark.parametrize(
    ("env", "command"),
    [
        (PushtEnv(), "lerobot-agpd-import-pusht"),
        (RobomimicEnvConfig(task="square"), "lerobot-agpd-import-robomimic"),
    ],
)
def test_tasks_without_expert_name_the_way_to_peoples_demonstrations(tmp_path, env, command):
    with pytest.raises(ValueError, match=f"no scripted expert.* {command} imports people's demonstrations"):
        DemosConfig(root=tmp_path / "x", env=env)


def test_existing_root_is_refused(tmp_path):
    with pytest.raises(FlagError, match="--root="):
        reach_config(tmp_path)


@pytest.mark.parametrize(("seed", "episodes"), [(100_000, 1), (99_999, 2), (-1, 1)])
def test_seeds_of_evaluations_are_refused(tmp_path, seed, episodes):
    with pytest.raises(FlagError, match="--seed=.*100000"):
        reach_config(tmp_path / "x", seed=seed, episodes=episodes)


def test_seeds_never_run_into_those_of_evaluations(tmp_path, monkeypatch):
    monkeypatch.setattr(demos, "make_expert", lambda env: Expert(lazy_expert))
    with pytest.raises(RuntimeError, match="seeds 99998 to 99999"):
        record_demos(reach_config(tmp_path / "x", seed=99_998, episodes=2))


def test_other_requests_that_cannot_work_are_refused(tmp_path):
    with pytest.raises(FlagError, match="--episodes"):
        reach_config(tmp_path / "x", episodes=0)
    with pytest.raises(ValueError, match="pusht"):
        DemosConfig(root=tmp_path / "x", env=EnvConfig.get_choice_class("pusht")())
    for skill in (1.5, -0.1, [], [1.0, 2.0]):
        with pytest.raises(FlagError, match="--skill="):
            reach_config(tmp_path / "x", skill=skill)
    with pytest.raises(ValueError, match="FetchSlide-v4 has no scripted expert"):
        DemosConfig(root=tmp_path / "x", env=GymnasiumRoboticsEnv(task="FetchSlide-v4"))
