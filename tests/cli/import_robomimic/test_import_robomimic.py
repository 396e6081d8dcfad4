"""`lerobot-agpd-import-robomimic`: what is imported."""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest

h5py = pytest.importorskip("h5py")

from lerobot.utils.feature_utils import dataset_to_policy_features  # noqa: E402
from robomimic_files import ENV_ARGS, LENGTHS, Rollout, column, run_import, write  # noqa: E402

from lerobot_agpd.envs.robomimic_hdf5 import RobomimicFile, sha256  # noqa: E402
from lerobot_agpd.envs.robomimic_tasks import TASKS, key_dim  # noqa: E402

AGENT = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")


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


def test_provenance(imported, source):
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


def test_recordings_are_a_raw_robomimic_file(imported, rollouts):
    with RobomimicFile(imported.root / "meta/robomimic.hdf5") as file:
        assert file.demos == [f"demo_{i}" for i in range(4)]
        for demo, rollout in zip(file.demos, rollouts, strict=True):
            for key in ("actions", "states", "rewards", "dones"):
                stored = file.read(demo, key)
                assert stored.dtype == rollout.arrays[key].dtype
                np.testing.assert_array_equal(stored, rollout.arrays[key])
            assert file.model_xml(demo) == rollout.attributes["model_file"]
        with pytest.raises(ValueError, match="has no obs"):
            file.observation_shapes("demo_0")


# ---- which episodes ----


def test_episodes_count_numerically(rollouts, tmp_path):
    names = ["demo_10", "demo_2", "demo_0", "demo_1"]
    source = write(tmp_path / "lift.hdf5", rollouts, names=names)
    dataset = run_import(source, tmp_path / "data", episodes=[3, 0])
    report = json.loads((dataset.root / "meta/robomimic.json").read_text())
    assert [row["demo"] for row in report["episodes"]] == ["demo_10", "demo_0"]
    assert [column(dataset, "action", episode).shape[0] for episode in (0, 1)] == [8, 6]


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


# ---- files with less or more than robomimic's ----


def without(rollout, *keys):
    return replace(rollout, arrays={key: values for key, values in rollout.arrays.items() if key not in keys})


def test_rewards_and_dones_may_be_missing(rollouts, tmp_path, caplog):
    source = write(
        tmp_path / "generated.hdf5", [without(rollout, "rewards", "dones") for rollout in rollouts[2:]]
    )
    with caplog.at_level(logging.WARNING):
        dataset = run_import(source, tmp_path / "data")
    assert "rewards" in caplog.text and "dones" in caplog.text
    assert (dataset.num_episodes, dataset.num_frames) == (2, 11)
    assert not {"next.reward", "next.success", "next.done"} & set(dataset.features)
    with RobomimicFile(dataset.root / "meta/robomimic.hdf5") as file:
        assert not {"rewards", "dones"} & set(file.data["demo_0"])


def test_dones_alone_may_be_missing(rollouts, tmp_path):
    source = write(tmp_path / "generated.hdf5", [without(rollouts[1], "dones")])
    dataset = run_import(source, tmp_path / "data")
    assert "next.done" not in dataset.features
    assert column(dataset, "next.success", 0).ravel().tolist() == [False] * 6 + [True]


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
        kwargs = {**ENV_ARGS["1.4.1"]["env_kwargs"], "robots": ["Panda"] * task.n_robots}
        env_args = {**ENV_ARGS["1.4.1"], "env_name": task.robosuite_name, "env_kwargs": kwargs}
        file["data"].attrs["env_args"] = json.dumps(env_args)
    dataset = run_import(source, tmp_path / "data")
    expected = np.concatenate([numbers[key] for key in task.object_keys], axis=1)
    np.testing.assert_array_equal(column(dataset, "observation.environment_state", 0), expected)


# ---- images ----


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


def test_images_as_floats_are_the_same(images, tmp_path):
    source, played = images
    key = "agentview_image"
    floats = [replace(p, obs={**p.obs, key: p.obs[key].astype(np.float32) / 255}) for p in played]
    source = write(tmp_path / "float.hdf5", floats)
    dataset = run_import(source, tmp_path / "data", images=True, cameras=["agentview"], episodes=[0])
    for index, frame in enumerate(dataset):
        shown = (frame["observation.images.agentview"] * 255).round().permute(1, 2, 0).numpy()
        np.testing.assert_array_equal(shown, played[0].obs[key][index])


@pytest.mark.slow
def test_video_is_nearly_the_same(images, tmp_path):
    _, played = images
    smooth = np.linspace(0, 255, 64 * 64 * 3).reshape(1, 64, 64, 3).astype(np.uint8).repeat(2, axis=0)
    source = write(
        tmp_path / "smooth.hdf5", [replace(p, obs={**p.obs, "agentview_image": smooth}) for p in played]
    )
    options = {"images": True, "video": True, "cameras": ["agentview"], "episodes_per_shard": 1}
    dataset = run_import(source, tmp_path / "data", **options)
    assert dataset.meta.video_keys
    for index in range(len(dataset)):
        shown = dataset[index]["observation.images.agentview"].permute(1, 2, 0).numpy()
        assert np.abs(shown - smooth[0] / 255).mean() < 0.03
