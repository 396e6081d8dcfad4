"""The import of DAPG's demonstrations, against recordings of the environment itself and the human ones where they are."""

import json
import os
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli import import_adroit as command
from lerobot_agpd.cli.import_adroit import REPORT_PATH, ImportAdroitConfig, import_adroit
from lerobot_agpd.envs.dapg_recordings import INITIAL_STATES, read_recordings
from lerobot_agpd.envs.demonstrations import dataset_features
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.robotics_tasks import TASKS
from lerobot_agpd.flag_checks import FlagError

pytest.importorskip("gymnasium_robotics")

REAL = Path(__file__).parents[3] / "shared" / "data" / "adroit_door_human.npz"
DOOR = "AdroitHandDoor-v1"
LENGTHS = (6, 4)
HINGE = 28
"""The door's angle among qpos."""


def record(task: str, lengths=LENGTHS, prepare=lambda state: None) -> list[dict]:
    """Episodes of random actions, a third of them beyond the action space, in the form of DAPG's pickles."""
    env = GymnasiumRoboticsEnv(task=task, episode_length=1000).make_single()
    inner = env.unwrapped
    rng = np.random.default_rng(0)
    episodes = []
    for seed, length in enumerate(lengths):
        env.reset(seed=seed)
        state = inner.get_env_state()
        prepare(state)
        inner.set_env_state({key: state[key] for key in INITIAL_STATES[task]})
        actions = rng.uniform(-1.5, 1.5, (length, TASKS[task].action_dim))
        observations, rewards = [inner._get_obs()], []
        for action in actions:
            observation, reward, *_ = inner.step(action)
            observations.append(observation)
            rewards.append(reward)
        episodes.append(
            {
                "observations": np.array(observations[:-1]),
                "actions": actions,
                "rewards": np.array(rewards),
                "init_state_dict": state,
            }
        )
    env.close()
    return episodes


@pytest.fixture(scope="module")
def door() -> list[dict]:
    return record(DOOR)


def write_pickle(path: Path, episodes) -> Path:
    path.write_bytes(pickle.dumps(episodes, 3))
    return path


def as_npz(episodes: list[dict]) -> dict[str, np.ndarray]:
    rows = {key: np.concatenate([e[key] for e in episodes]) for key in ("observations", "actions", "rewards")}
    states = [episode["init_state_dict"] for episode in episodes]
    init = {f"init_{key}": np.stack([state[key] for state in states]) for key in states[0]}
    return {**rows, "episode_ends": np.cumsum([len(e["actions"]) for e in episodes]), **init}


@pytest.fixture
def source(door, tmp_path) -> Path:
    return write_pickle(tmp_path / "door-v0_demos.pickle", door)


def run(source: Path, **options) -> LeRobotDataset:
    return import_adroit(ImportAdroitConfig(source=source, root=source.parent / "data", **options))[0]


def column(dataset: LeRobotDataset, key: str) -> np.ndarray:
    return np.stack([frame[key].numpy() for frame in dataset])


@pytest.mark.parametrize("task", INITIAL_STATES)
def test_frames_are_those_of_the_file_with_actions_clipped(task, tmp_path):
    episodes = record(task)
    dataset = run(write_pickle(tmp_path / "demos.pickle", episodes))
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, sum(LENGTHS), 100)
    expected = as_npz(episodes)
    numbers = np.stack([np.concatenate(TASKS[task].split(row)) for row in expected["observations"]])
    shown = np.hstack(
        [column(dataset, "observation.state"), column(dataset, "observation.environment_state")]
    )
    np.testing.assert_allclose(shown, numbers, atol=1e-5)
    np.testing.assert_array_equal(
        column(dataset, "action"), np.clip(expected["actions"], -1, 1).astype(np.float32)
    )
    np.testing.assert_allclose(column(dataset, "next.reward").ravel(), expected["rewards"], atol=1e-3)
    assert column(dataset, "next.done").ravel().tolist() == [False] * 5 + [True] + [False] * 3 + [True]
    assert column(dataset, "episode_index").tolist() == [0] * 6 + [1] * 4
    assert dataset[0]["task"] == TASKS[task].description


def test_features_are_those_of_the_environments_own_demonstrations(source):
    dataset = run(source)
    expected = dataset_features(GymnasiumRoboticsEnv(task=DOOR))
    shapes = {key: (feature["dtype"], tuple(feature["shape"])) for key, feature in dataset.features.items()}
    assert {key: shapes[key] for key in expected} == {
        key: (feature["dtype"], tuple(feature["shape"])) for key, feature in expected.items()
    }
    own = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
    assert set(shapes) - set(expected) == own


def assert_replays(dataset: LeRobotDataset, source: Path, episodes) -> None:
    """Play the stored actions from the recorded states in a new environment, and compare bit by bit."""
    report = json.loads((dataset.root / REPORT_PATH).read_text())
    env = GymnasiumRoboticsEnv(task=DOOR, episode_length=report["episode_length"]).make_single()
    recordings = read_recordings(source)
    frames = list(dataset)
    for number, episode in enumerate(episodes):
        state = recordings[episode].initial_state
        observation, _ = env.reset(seed=7, options={"initial_state_dict": state})
        for frame in (frame for frame in frames if frame["episode_index"] == number):
            np.testing.assert_array_equal(observation["agent_pos"], frame["observation.state"])
            np.testing.assert_array_equal(
                observation["environment_state"], frame["observation.environment_state"]
            )
            observation, reward, _, truncated, info = env.step(frame["action"].numpy())
            assert np.float32(reward) == frame["next.reward"].item()
            assert info["is_success"] == frame["next.success"].item()
            assert not truncated or frame["next.done"].item()
    env.close()


def test_dataset_replays_in_the_environment(source):
    assert_replays(run(source), source, [0, 1])


def test_npz_holds_what_the_pickle_holds(door, source, tmp_path):
    path = tmp_path / "door.npz"
    np.savez(path, **as_npz(door))
    for left, right in zip(read_recordings(source), read_recordings(path), strict=True):
        assert left.task == right.task == DOOR
        for key in ("observations", "actions", "rewards"):
            np.testing.assert_array_equal(getattr(left, key), getattr(right, key))
        assert left.initial_state.keys() == right.initial_state.keys()
        for key, values in left.initial_state.items():
            np.testing.assert_array_equal(values, right.initial_state[key])


def test_episodes_are_chosen_in_the_requested_order(source, door):
    dataset = run(source, episodes=[1, 0])
    np.testing.assert_array_equal(
        dataset[0]["action"], np.clip(door[1]["actions"][0], -1, 1).astype(np.float32)
    )
    report = json.loads((dataset.root / REPORT_PATH).read_text())
    assert [entry["episode"] for entry in report["episodes"]] == [1, 0]
    assert report["episode_length"] == 6


def test_successful_episodes_are_told_apart(tmp_path, door):
    opened = record(DOOR, (3,), lambda state: state["qpos"].__setitem__(HINGE, 1.5))
    source = write_pickle(tmp_path / "demos.pickle", [door[0], *opened])
    dataset = run(source, keep="successful")
    assert (dataset.num_episodes, dataset.num_frames) == (1, 3)
    assert column(dataset, "next.success").all()
    report = json.loads((dataset.root / REPORT_PATH).read_text())
    assert [entry["episode"] for entry in report["left_out"]] == [0]
    [entry] = report["episodes"]
    assert entry["success_at_any_step"] and entry["success_at_last_step"]


def test_command_says_how_to_replay(source, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["command", f"--source={source}", f"--root={tmp_path / 'out'}"])
    command.main()
    printed = capsys.readouterr().err
    assert "0 of them reach the goal" in printed
    assert f"--env.task={DOOR} --env.episode_length=6" in printed


def spoiled(key, change):
    """A change of one array of episode 1."""
    return lambda episodes: [episodes[0], {**episodes[1], key: change(episodes[1][key].copy())}]


def with_nan(values):
    values[2] = np.nan
    return values


class Evil:
    def __reduce__(self):
        return os.system, ("true",)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: [], "must hold a list of episodes, found an empty list"),
        (lambda e: e[0], "must hold a list of episodes, found a dict"),
        (lambda e: [e[0], 3], "episode 1 must be a dict with observations, .*; found a int"),
        (lambda e: [{k: v for k, v in e[0].items() if k != "rewards"}], r"episode 0 must be a dict .*rewards.*; found"),
        (lambda e: [{**e[0], "init_state_dict": {"qpos": np.zeros(30)}}], "the initial state has .'qpos'., expected one of"),
        (lambda e: [{**e[0], "init_state_dict": 3}], r"the initial state has \[\], expected one of"),
        (lambda e: [*e, *record("AdroitHandPen-v1", (2,))], "mixes the tasks AdroitHandDoor-v1, AdroitHandPen-v1"),
        (spoiled("actions", with_nan), "episode 1: actions is not finite in row 2"),
        (spoiled("observations", with_nan), "episode 1: observations is not finite in row 2"),
        (spoiled("actions", lambda a: a[:, :24]), r"episode 1: actions has shape \(4, 24\), expected \(4, 28\)"),
        (spoiled("observations", lambda a: a[:3]), r"episode 1: observations has shape \(3, 39\), expected \(4, 39\)"),
        (spoiled("actions", lambda a: a[:0]), "episode 1 has no actions"),
        (spoiled("rewards", lambda a: a.astype(object)), "episode 1: rewards must be an array of numbers, found object"),
        (spoiled("rewards", lambda a: a.tolist()), "episode 1: rewards must be an array of numbers, found list"),
        (spoiled("rewards", lambda a: Evil()), "no pickle of numpy arrays: it names posix.system"),
    ],
)  # fmt: skip
def test_pickles_that_do_not_fit_are_refused(door, tmp_path, change, message):
    source = write_pickle(tmp_path / "demos.pickle", change(door))
    with pytest.raises(ValueError, match=message) as raised:
        run(source)
    assert str(source) in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not list(tmp_path.glob("data*"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: {"x": np.zeros(1)}, r"no array \['observations', 'actions', 'rewards', 'episode_ends'\]; found"),
        (lambda a: {**a, "episode_ends": np.array([10, 6])}, "episode_ends must rise"),
        (lambda a: {**a, "episode_ends": np.array([0, 10])}, "episode_ends must rise"),
        (lambda a: {**a, "episode_ends": np.array([6, 12])}, "observations has 10 rows, episode_ends has 2 episodes and 12 rows"),
        (lambda a: {**a, "episode_ends": np.array([6.0, 10.0])}, "episode_ends must be row numbers"),
        (lambda a: {**a, "episode_ends": np.array(5)}, "episode_ends must be row numbers"),
        (lambda a: {**a, "init_qpos": a["init_qpos"][:1]}, "init_qpos has 1 rows, episode_ends has 2 episodes and 10 rows"),
        (lambda a: {k: v for k, v in a.items() if k != "init_qvel"}, "episode 0: the initial state has .*, expected one of"),
        (lambda a: {**a, "rewards": np.array(3.0)}, "rewards has 1 rows"),
        (lambda a: {**a, "actions": a["actions"].astype(object)}, "cannot be read: Object arrays"),
    ],
)  # fmt: skip
def test_npz_files_that_do_not_fit_are_refused(door, tmp_path, change, message):
    source = tmp_path / "demos.npz"
    np.savez(source, **change(as_npz(door)))
    with pytest.raises(ValueError, match=message) as raised:
        run(source)
    assert str(source) in str(raised.value)
    assert not list(tmp_path.glob("data*"))


def test_what_is_no_npz_file_is_refused(tmp_path):
    source = tmp_path / "text.npz"
    source.write_text("not an archive")
    with pytest.raises(ValueError, match="text.npz is not an .npz file"):
        run(source)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"episodes": [2]}, r"--episodes=\[2\]: .* has 2 episodes, 0 to 1"),
        ({"episodes": []}, "--episodes=.* at least one"),
        ({"episodes": [-1]}, "--episodes=.* counted from 0"),
        ({"episodes": [0, 0]}, "--episodes=.* none twice"),
        (
            {"keep": "successful"},
            "--keep=successful: none of 2 episodes reaches the goal of AdroitHandDoor-v1",
        ),
    ],
)
def test_options_that_do_not_fit_are_refused(source, tmp_path, options, message):
    with pytest.raises((FlagError, ValueError), match=message):
        run(source, **options)
    assert not list(tmp_path.glob("data*"))


def test_folders_that_are_wrong_are_refused(source, tmp_path):
    with pytest.raises(FlagError, match="--source="):
        ImportAdroitConfig(source=tmp_path / "nothing.pickle", root=tmp_path / "data")
    with pytest.raises(FlagError, match="--source="):
        ImportAdroitConfig(source=tmp_path, root=tmp_path / "data")
    with pytest.raises(FlagError, match="--root="):
        ImportAdroitConfig(source=source, root=tmp_path)


@pytest.mark.skipif(not REAL.exists(), reason="the human recordings are not at hand")
def test_the_human_recordings(tmp_path):
    config = ImportAdroitConfig(source=REAL, root=tmp_path / "data", episodes=[0, 24], keep="successful")
    dataset, report = import_adroit(config)
    assert (dataset.num_episodes, dataset.num_frames, report.episode_length) == (1, 225, 225)
    assert (dataset.num_frames, report.task) == (225, DOOR)
    [kept], [left_out] = report.episodes, report.left_out
    assert (kept["episode"], left_out["episode"]) == (24, 0)
    # The recorded hand starts elsewhere than the recorded state; after half a second of 300 steps they are together.
    recorded = read_recordings(REAL)[24].observations
    shown = column(dataset, "observation.state")
    hand = np.stack([TASKS[DOOR].split(row)[0] for row in recorded])
    differences = np.abs(shown - hand).mean(axis=1)
    assert differences[0] > 0.03 and differences[50:].mean() < 0.01
    assert_replays(dataset, REAL, [24])
