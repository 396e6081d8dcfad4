"""`lerobot-agpd-import-robomimic` on files of real robosuite rollouts."""

import json
import logging
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

h5py = pytest.importorskip("h5py")
pytest.importorskip("robosuite")

from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from lerobot.utils.feature_utils import dataset_to_policy_features  # noqa: E402
from robomimic_files import ENV_ARGS, Rollout, make_lift, record, write  # noqa: E402

from lerobot_agpd.cli import import_robomimic as command  # noqa: E402
from lerobot_agpd.cli.import_robomimic import ImportRobomimicConfig, import_robomimic  # noqa: E402
from lerobot_agpd.envs.robomimic_columns import RobomimicColumns  # noqa: E402
from lerobot_agpd.envs.robomimic_hdf5 import RobomimicFile, sha256  # noqa: E402
from lerobot_agpd.envs.robomimic_recordings import load_recording  # noqa: E402
from lerobot_agpd.envs.robomimic_tasks import TASKS, key_dim  # noqa: E402

AGENT = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")
LENGTHS = (48, 47, 6, 5)
SCALARS = ("next.reward", "next.success", "next.done")


@pytest.fixture(scope="session")
def rollouts() -> list[Rollout]:
    """Two demonstrations that lift the cube, and two too short for it."""
    env = make_lift()
    played = [record(env, seed, n_steps) for seed, n_steps in enumerate(LENGTHS)]
    env.close()
    return played


@pytest.fixture(scope="session")
def source(rollouts, tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("robomimic") / "low_dim_v15.hdf5", rollouts)


@pytest.fixture(scope="session")
def imported(source, tmp_path_factory) -> LeRobotDataset:
    """The whole file, through the console command, in two shards."""
    root = tmp_path_factory.mktemp("data") / "nested" / "lift"
    argv = ["command", str(source), f"--root={root}", "--repo_id=local/lift", "--episodes_per_shard=3"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", argv)
        command.main()
    return LeRobotDataset("local/lift", root=root)


def part(rollout: Rollout, start: int = 0, stop: int = 3) -> Rollout:
    """Some steps of a rollout."""
    parts = [
        {key: values[start:stop] for key, values in arrays.items()}
        for arrays in (rollout.arrays, rollout.obs, rollout.next_obs)
    ]
    return Rollout(*parts, rollout.attributes)


def column(dataset: LeRobotDataset, key: str, episode: int) -> np.ndarray:
    rows = dataset.hf_dataset.with_format("numpy")[:]
    return np.stack(rows[key])[rows["episode_index"] == episode]


def run_import(source: Path, root: Path, **options) -> LeRobotDataset:
    return import_robomimic(ImportRobomimicConfig(source=source, root=root, **options))


# ---- what is imported ----


def test_every_value_is_the_files_in_float32(imported, rollouts):
    assert (imported.fps, imported.num_episodes, imported.num_frames) == (20, 4, sum(LENGTHS))
    for episode, rollout in enumerate(rollouts):
        state = np.concatenate([rollout.obs[key] for key in AGENT], axis=1)
        expected = {
            "observation.state": state.astype(np.float32),
            "observation.environment_state": rollout.obs["object"].astype(np.float32),
            "action": rollout.arrays["actions"].astype(np.float32),
            "next.reward": rollout.arrays["rewards"].astype(np.float32),
            "next.success": rollout.arrays["rewards"] == 1,
            "next.done": rollout.arrays["dones"] == 1,
        }
        for key, values in expected.items():
            stored = column(imported, key, episode)
            assert stored.dtype == values.dtype
            np.testing.assert_array_equal(stored.reshape(values.shape), values)


def test_demonstrations_that_lift_the_cube_end_in_success(imported):
    assert [column(imported, "next.success", episode).any() for episode in range(4)] == [
        True,
        True,
        False,
        False,
    ]
    assert imported[0]["task"] == TASKS["lift"].description
    assert not list(imported.root.parent.glob("*.partial")) and not list(imported.root.parent.glob("*.new"))


def test_statistics_do_not_depend_on_the_shards(imported, source, tmp_path):
    whole = run_import(source, tmp_path / "data")
    for key in ("observation.state", "action"):
        for name in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(
                imported.meta.stats[key][name], whole.meta.stats[key][name], rtol=1e-5, atol=1e-7
            )


def test_a_policy_sees_what_the_environment_type_shows(imported):
    from lerobot_agpd.envs.robomimic import RobomimicEnvConfig

    env = RobomimicEnvConfig(task="lift")
    shown = {env.features_map[key]: tuple(feature.shape) for key, feature in env.features.items()}
    features = dataset_to_policy_features(imported.features)
    assert {key: tuple(features[key].shape) for key in shown} == shown


def test_provenance(imported, source, rollouts):
    report = json.loads((imported.root / "meta/robomimic.json").read_text())
    assert report["source"] == {
        "file": source.name,
        "sha256": sha256(source),
        "bytes": source.stat().st_size,
    }
    assert report["env_args"] == ENV_ARGS["1.5.1"]
    assert report["robosuite_version"] == "1.5.1"
    assert [(row["demo"], row["length"]) for row in report["episodes"]] == [
        (f"demo_{i}", length) for i, length in enumerate(LENGTHS)
    ]
    for episode, rollout in enumerate(rollouts):
        recording = load_recording(imported.root, f"demo_{episode}")
        for key in ("actions", "states", "rewards", "dones"):
            stored = getattr(recording, key)
            assert stored.dtype == rollout.arrays[key].dtype
            np.testing.assert_array_equal(stored, rollout.arrays[key])
        assert recording.model_xml == rollout.attributes["model_file"]


def test_recordings_are_a_raw_robomimic_file(imported):
    with RobomimicFile(imported.root / "meta/robomimic.hdf5") as file:
        assert file.demos == [f"demo_{i}" for i in range(4)]
        with pytest.raises(ValueError, match="has no obs"):
            file.observation_shapes("demo_0")


def test_recorded_actions_replayed_reproduce_the_recording(imported):
    from lerobot_agpd.envs.robosuite_sim import RobosuiteEnv

    recording = load_recording(imported.root, "demo_1")
    env = RobosuiteEnv("lift")
    observation, _ = env.reset_to(recording.states[0], recording.model_xml)
    states, successes, observations = [], [], []
    for action in recording.actions:
        states.append(env.get_state())
        observations.append(observation)
        observation, *_, info = env.step(action)
        successes.append(info["is_success"])
    env.close()
    np.testing.assert_allclose(states, recording.states, atol=1e-3)
    positions = slice(1, 17)  # after the time: seven joints, two fingers, the cube's position and quaternion
    np.testing.assert_allclose(np.array(states)[:, positions], recording.states[:, positions], atol=1e-4)
    assert successes == column(imported, "next.success", 1).ravel().tolist() and successes[-1]
    for raw, key in (
        ("agent_pos", "observation.state"),
        ("environment_state", "observation.environment_state"),
    ):
        shown = np.stack([seen[raw] for seen in observations])
        np.testing.assert_allclose(shown, column(imported, key, 1), atol=1e-4)


# ---- which episodes ----


def test_episodes_count_numerically(rollouts, tmp_path):
    names = ["demo_10", "demo_2", "demo_0", "demo_1"]
    source = write(tmp_path / "lift.hdf5", rollouts, names=names)
    dataset = run_import(source, tmp_path / "data", episodes=[3, 0])
    report = json.loads((dataset.root / "meta/robomimic.json").read_text())
    assert [row["demo"] for row in report["episodes"]] == ["demo_10", "demo_0"]
    assert [column(dataset, "action", episode).shape[0] for episode in (0, 1)] == [48, 6]


def test_masks_choose_and_name_operators(rollouts, tmp_path):
    masks = {
        "better_operator_1": ["demo_2"],
        "better_operator_1_train": ["demo_2"],
        "worse_operator_2": ["demo_3", "demo_0"],
        "better": ["demo_2"],
        "50_percent": ["demo_3", "demo_1", "demo_2"],
    }
    source = write(tmp_path / "lift.hdf5", rollouts, masks=masks)
    dataset = run_import(source, tmp_path / "data", filter_key="50_percent")
    assert [column(dataset, "operator", episode)[0].item() for episode in range(3)] == [-1, 0, 1]
    report = json.loads((dataset.root / "meta/robomimic.json").read_text())
    assert report["operators"] == ["better_operator_1", "worse_operator_2"]
    assert [(row["demo"], row["operator"]) for row in report["episodes"]] == [
        ("demo_1", None),
        ("demo_2", "better_operator_1"),
        ("demo_3", "worse_operator_2"),
    ]
    assert report["masks"] == masks
    assert "operator" not in dataset_to_policy_features(dataset.features)  # no policy reads it


# ---- files of robosuite 1.4.1 ----


def test_files_of_141_get_todays_signs(rollouts, tmp_path, caplog):
    """Lift of robosuite 1.4.1 reports the vector from the cube to the hand."""
    obs = {key: values.copy() for key, values in rollouts[2].obs.items()}
    obs["object"][:, 7:] *= -1
    source = write(tmp_path / "low_dim_v141.hdf5", [replace(rollouts[2], obs=obs)], version="1.4.1")
    with caplog.at_level(logging.WARNING):
        dataset = run_import(source, tmp_path / "data")
    assert "robosuite 1.4.1" in caplog.text
    expected = rollouts[2].obs["object"].astype(np.float32)
    np.testing.assert_array_equal(column(dataset, "observation.environment_state", 0), expected)


@pytest.mark.parametrize("name", ["can", "transport"])
def test_files_of_141_get_todays_order(name, tmp_path):
    """Every key of the object state is found by a number of its own."""
    task = TASKS[name]
    numbers = {key: np.full((2, key_dim(key)), i + 1.0) for i, key in enumerate(task.object_keys)}
    obs = {key: np.zeros((2, key_dim(key))) for key in task.agent_keys}
    obs["object"] = np.concatenate([numbers[key] for key in task.object_keys_v141], axis=1)
    arrays = {"actions": np.zeros((2, task.action_dim)), "states": np.zeros((2, 9))}
    arrays |= {"rewards": np.zeros(2), "dones": np.array([0, 1])}
    source = write(tmp_path / "v141.hdf5", [Rollout(arrays, obs, obs, {})], version="1.4.1")
    with h5py.File(source, "a") as file:
        file["data"].attrs["env_args"] = json.dumps({**ENV_ARGS["1.4.1"], "env_name": task.robosuite_name})
    dataset = run_import(source, tmp_path / "data")
    expected = np.concatenate([numbers[key] for key in task.object_keys], axis=1)
    np.testing.assert_array_equal(column(dataset, "observation.environment_state", 0), expected)


# ---- images ----


@pytest.fixture(scope="session")
def images(tmp_path_factory) -> tuple[Path, list[Rollout]]:
    """Two demonstrations of two steps, seen by two cameras of 64 pixels."""
    try:
        env = make_lift(cameras=("agentview", "robot0_eye_in_hand"), size=64)
        rollout = record(env, 0, 4)
    except Exception as error:  # whatever the graphics library raises
        pytest.skip(f"no graphics context (is MUJOCO_GL set?): {error}")
    env.close()
    played = [part(rollout, 0, 2), part(rollout, 2, 4)]
    return write(tmp_path_factory.mktemp("images") / "image_v15.hdf5", played), played


def test_images_are_lossless(images, tmp_path):
    source, played = images
    dataset = run_import(source, tmp_path / "data", images=True, episodes_per_shard=1)
    assert "observation.environment_state" not in dataset.features
    for index, frame in enumerate(dataset):
        for camera in ("agentview", "robot0_eye_in_hand"):
            shown = (frame[f"observation.images.{camera}"] * 255).round().permute(1, 2, 0).numpy()
            np.testing.assert_array_equal(shown, played[index // 2].obs[f"{camera}_image"][index % 2])


def test_one_camera_beside_the_objects_state(images, tmp_path):
    options = {"images": True, "cameras": ["agentview"], "environment_state": True}
    dataset = run_import(images[0], tmp_path / "data", **options)
    assert dataset.meta.camera_keys == ["observation.images.agentview"]
    assert dataset.features["observation.environment_state"]["shape"] == (10,)


@pytest.mark.slow
def test_video_is_nearly_the_same(images, tmp_path):
    source, played = images
    dataset = run_import(source, tmp_path / "data", images=True, video=True, episodes_per_shard=1)
    assert dataset.meta.video_keys
    for index in range(len(dataset)):
        shown = dataset[index]["observation.images.agentview"].permute(1, 2, 0).numpy()
        original = played[index // 2].obs["agentview_image"][index % 2] / 255
        assert np.abs(shown - original).mean() < 0.03


# ---- interrupted imports ----


@pytest.mark.slow
def test_killed_import_goes_on(rollouts, imported, tmp_path):
    """`kill -9` between two shards; finished ones are not written again."""
    source = write(tmp_path / "lift.hdf5", [part(rollouts[i % 4]) for i in range(40)])
    root, partial = tmp_path / "data", tmp_path / "data.partial"
    argv = [
        sys.executable,
        "-m",
        "lerobot_agpd.cli.import_robomimic",
        str(source),
        f"--root={root}",
        "--episodes_per_shard=2",
    ]
    process = subprocess.Popen(argv, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while len(list(partial.glob("shard-*"))) < 2 and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not root.exists()
    finished = {path: path.stat().st_mtime_ns for path in partial.glob("shard-*/meta/info.json")}
    assert 2 <= len(finished) < 20

    rewritten = []
    with pytest.MonkeyPatch.context() as patch:
        create = LeRobotDataset.create
        patch.setattr(
            command.LeRobotDataset,
            "create",
            lambda *args, **kwargs: rewritten.append(0) or create(*args, **kwargs),
        )
        dataset = run_import(source, root, episodes_per_shard=2)
    assert len(rewritten) == 20 - len(finished)
    assert (dataset.num_episodes, dataset.num_frames) == (40, 120)
    for episode in range(40):
        expected = rollouts[episode % 4].arrays["actions"][:3].astype(np.float32)
        np.testing.assert_array_equal(column(dataset, "action", episode), expected)


def test_interrupted_import_goes_on(source, rollouts, tmp_path, monkeypatch):
    read, seen = RobomimicColumns.read, []

    def read_three(columns, demo):
        seen.append(demo)
        if len(seen) > 3:
            raise KeyboardInterrupt
        return read(columns, demo)

    monkeypatch.setattr(RobomimicColumns, "read", read_three)
    with pytest.raises(KeyboardInterrupt):
        run_import(source, tmp_path / "data", episodes_per_shard=2)
    assert {path.name for path in (tmp_path / "data.partial").iterdir()} == {
        "plan.json",
        "shard-000000",
        "unfinished",
    }
    seen.clear()
    dataset = run_import(source, tmp_path / "data", episodes_per_shard=2)
    assert seen == ["demo_2", "demo_3"]  # of the unfinished shard both, of the finished one none
    for episode, rollout in enumerate(rollouts):
        expected = rollout.arrays["actions"].astype(np.float32)
        np.testing.assert_array_equal(column(dataset, "action", episode), expected)


def test_import_killed_while_merging_goes_on(source, tmp_path, monkeypatch):
    def die(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "copy_recordings", die)
    with pytest.raises(KeyboardInterrupt):
        run_import(source, tmp_path / "data")
    assert (tmp_path / "data.partial/merged").exists() and not (tmp_path / "data").exists()
    monkeypatch.undo()
    assert run_import(source, tmp_path / "data").num_episodes == 4


def test_another_file_or_option_does_not_continue(source, rollouts, tmp_path, monkeypatch):
    monkeypatch.setattr(command.ShardedWriter, "write", lambda *args: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_import(source, tmp_path / "data", episodes=[0, 1])
    monkeypatch.undo()
    with pytest.raises(FileExistsError, match=r"other options \(demos was .*'demo_1'\], is now .*'demo_2'\]"):
        run_import(source, tmp_path / "data", episodes=[0, 2])
    other = write(tmp_path / "other.hdf5", rollouts[2:])
    with pytest.raises(FileExistsError, match=r"other options \(source was"):
        run_import(other, tmp_path / "data", episodes=[0, 1])
    shutil.rmtree(tmp_path / "data.partial")
    (tmp_path / "data.partial").mkdir()
    with pytest.raises(FileExistsError, match="no unfinished import"):
        run_import(source, tmp_path / "data")


# ---- wrong input ----


@pytest.fixture
def edited(rollouts, tmp_path):
    """Writes a small file and lets a test spoil it."""

    def edit(spoil) -> Path:
        path = write(tmp_path / "edited.hdf5", [part(rollouts[0]), part(rollouts[1])])
        with h5py.File(path, "a") as file:
            spoil(file)
        return path

    return edit


def spoil(key, change):
    """Replaces an array by a changed one."""

    def apply(file):
        values = change(file[key][()])
        del file[key]
        file[key] = values

    return apply


def with_env_args(**changes):
    def apply(file):
        file["data"].attrs["env_args"] = json.dumps({**ENV_ARGS["1.5.1"], **changes})

    return apply


def with_nan(values):
    values[2, 1] = np.nan
    return values


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.move("data", "trajectories"), r"no robomimic dataset: expected a group 'data'.*traj"),
        (lambda file: file["data"].attrs.pop("env_args"), r"attribute env_args; found .*\['total'\]"),
        (with_env_args(env_name="Stack"), "env_name must be one of Lift, PickPlaceCan, .* found 'Stack'"),
        (with_env_args(env_kwargs={}), "control_freq must be a positive number, found None"),
        (spoil("data/demo_1/actions", lambda x: x[:2]), r"demo_1/actions has shape \(2, 7\), expected \(3, 7\)"),
        (spoil("data/demo_1/obs/object", lambda x: x[:, :9]), r"demo_1/obs/object has shape \(3, 9\)"),
        (spoil("data/demo_0/states", lambda x: x[:1]), "demo_0/states has 1 rows, expected 3"),
        (spoil("data/demo_1/actions", with_nan), "demo_1/actions is not finite in float32 at step 2"),
        (spoil("data/demo_1/obs/object", lambda x: x + 1e39), "demo_1/obs/object is not finite .* step 0"),
        (lambda file: file.pop("data/demo_1/obs/robot0_eef_quat"), r"no obs/robot0_eef_quat; found .*eef_pos"),
        (lambda file: file.pop("data/demo_0/rewards"), r"demo_0 has no rewards; found \['actions'"),
        (lambda file: [file.pop(f"data/demo_{i}") for i in (0, 1)], "no demonstrations: expected groups"),
        (lambda file: file["data/demo_1"].attrs.pop("num_samples"), "demo_1 has no attribute num_samples"),
    ],
)  # fmt: skip
def test_spoilt_files_are_named(edited, tmp_path, change, message):
    path = edited(change)
    with pytest.raises(ValueError, match=message) as raised:
        run_import(path, tmp_path / "data")
    assert str(path) in str(raised.value)
    assert not (tmp_path / "data").exists()


def test_raw_files_need_observations_first(rollouts, tmp_path):
    source = write(tmp_path / "demo_v15.hdf5", [part(rollouts[0])], observations=False)
    with pytest.raises(
        ValueError, match=r"simulator states only.*dataset_states_to_obs --dataset .*demo_v15"
    ):
        run_import(source, tmp_path / "data")


def test_what_is_no_hdf5_file_or_half_of_one(source, tmp_path):
    text = tmp_path / "text.hdf5"
    text.write_text("not HDF5")
    with pytest.raises(ValueError, match="text.hdf5 is not an HDF5 file"):
        run_import(text, tmp_path / "data")
    half = tmp_path / "half.hdf5"
    half.write_bytes(source.read_bytes()[: source.stat().st_size // 2])
    with pytest.raises(ValueError, match="half.hdf5 is truncated or damaged"):
        run_import(half, tmp_path / "data")


def test_what_the_file_does_not_have_is_listed(source, rollouts, tmp_path):
    masked = write(tmp_path / "masked.hdf5", rollouts[2:], masks={"train": ["demo_0"], "valid": ["demo_7"]})
    for path, options, message in (
        (source, {"episodes": [0, 4]}, r"--episodes=\[4\]: .* has 4 demonstrations, 0 to 3"),
        (source, {"episodes": [-1]}, r"--episodes=\[-1\]"),
        (source, {"filter_key": "train"}, "--filter_key=train: .* has the masks none"),
        (masked, {"filter_key": "20_percent"}, r"has the masks \['train', 'valid'\]"),
        (masked, {"filter_key": "valid"}, r"--filter_key=valid names \['demo_7'\]"),
        (source, {"images": True}, r"no observations named <camera>_image; found \['object'"),
    ):
        with pytest.raises(ValueError, match=message):
            run_import(path, tmp_path / "data", **options)


def test_missing_camera_is_named(images, tmp_path):
    with pytest.raises(ValueError, match=r"--cameras=\['sideview'\].*\['agentview', 'robot0_eye_in_hand'\]"):
        run_import(images[0], tmp_path / "data", images=True, cameras=["sideview"])


def test_wrong_options_are_named(source, tmp_path):
    for options, error, message in (
        ({"source": tmp_path / "nothing.hdf5"}, FileNotFoundError, "--source="),
        ({"root": tmp_path}, FileExistsError, "--root="),
        ({"episodes": [0], "filter_key": "train"}, ValueError, "either --episodes or --filter_key"),
        ({"episodes": [1, 1]}, ValueError, r"--episodes=\[1, 1\] .* none twice"),
        ({"episodes": []}, ValueError, "--episodes="),
        ({"video": True}, ValueError, "--images=true"),
        ({"episodes_per_shard": 0}, ValueError, "--episodes_per_shard"),
    ):
        with pytest.raises(error, match=message):
            ImportRobomimicConfig(**{"source": source, "root": tmp_path / "data", **options})


def test_only_a_first_word_is_the_source():
    assert command.with_source_flag(["a.hdf5", "--root=b"]) == ["--source=a.hdf5", "--root=b"]
    assert command.with_source_flag(["--root=b", "--source=a"]) == ["--root=b", "--source=a"]
    assert command.with_source_flag([]) == []


def test_missing_h5py_names_the_extra(source, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lerobot_policy_agpd\[robomimic\]'"):
        run_import(source, tmp_path / "data")
