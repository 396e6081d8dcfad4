"""Files and options that the import of robomimic's data refuses, and what it says."""

import json
import logging
import sys
from pathlib import Path

import numpy as np
import pytest

h5py = pytest.importorskip("h5py")

from robomimic_files import ENV_ARGS, RIGHT_ARM, V141, part, run_import, write  # noqa: E402

from lerobot_agpd.cli.import_robomimic import ImportRobomimicConfig  # noqa: E402
from lerobot_agpd.flag_checks import FlagError  # noqa: E402


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


def with_env_kwargs(**changes):
    return with_env_args(env_kwargs={**ENV_ARGS["1.5.1"]["env_kwargs"], **changes})


def with_controller(**changes):
    controller = {"type": "BASIC", "body_parts": {"right": {**RIGHT_ARM, **changes}}}
    return with_env_kwargs(controller_configs=controller)


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
        (with_env_kwargs(control_freq=10), r"control_freq 10 \(expected 20\)"),
        (with_env_kwargs(robots=["Sawyer"]), r"robots \['Sawyer'\]"),
        (with_controller(type="JOINT_POSITION"), "controller type JOINT_POSITION"),
        (with_controller(input_type="absolute"), "controller input_type absolute"),
        (with_controller(input_ref_frame="base"), "controller input_ref_frame base"),
        (with_controller(output_max=0.1), "controller output_max 0.1"),
        (with_env_kwargs(controller_configs={**V141, "control_delta": False}), "controller input_type absolute"),
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
    assert not list(tmp_path.glob("data*"))


def test_a_file_that_does_not_tell_its_controller_is_taken_with_a_warning(edited, tmp_path, caplog):
    path = edited(with_env_kwargs(controller_configs=None))
    with caplog.at_level(logging.WARNING):
        run_import(path, tmp_path / "data")
    assert "OSC_POSE is assumed" in caplog.text


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
    masked = write(
        tmp_path / "masked.hdf5", rollouts[2:], masks={"train": ["demo_0"], "valid": ["demo_7"], "none": []}
    )
    for path, options, message in (
        (source, {"episodes": [0, 4]}, r"--episodes=\[4\]: .* has 4 demonstrations, 0 to 3"),
        (source, {"episodes": [-1]}, r"--episodes=\[-1\]"),
        (source, {"filter_key": "train"}, "--filter_key=train: .* has the masks none"),
        (masked, {"filter_key": "20_percent"}, r"has the masks \['none', 'train', 'valid'\]"),
        (masked, {"filter_key": "valid"}, r"--filter_key=valid: .* names \['demo_7'\]"),
        (masked, {"filter_key": "none"}, "--filter_key=none: .* selects no demonstration"),
        (source, {"images": True}, r"no observations named <camera>_image; found \['object'"),
    ):
        with pytest.raises(ValueError, match=message):
            run_import(path, tmp_path / "data", **options)


def test_missing_camera_is_named(images, tmp_path):
    with pytest.raises(ValueError, match=r"--cameras=\['sideview'\].*\['agentview', 'robot0_eye_in_hand'\]"):
        run_import(images[0], tmp_path / "data", images=True, cameras=["sideview"])


def test_wrong_options_are_named(source, tmp_path):
    for options, message in (
        ({"source": tmp_path / "nothing.hdf5"}, "--source="),
        ({"root": tmp_path}, "--root="),
        ({"episodes": [0], "filter_key": "train"}, "either --episodes or --filter_key"),
        ({"episodes": [1, 1]}, r"--episodes=\[1, 1\]"),
        ({"episodes": []}, "--episodes="),
        ({"video": True}, "--images=true"),
        ({"episodes_per_shard": 0}, "--episodes_per_shard"),
    ):
        with pytest.raises(FlagError, match=message):
            ImportRobomimicConfig(**{"source": source, "root": tmp_path / "data", **options})


def test_missing_h5py_names_the_extra(source, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lerobot_policy_agpd\[robomimic\]'"):
        run_import(source, tmp_path / "data")
