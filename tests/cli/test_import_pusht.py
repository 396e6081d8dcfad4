"""The Push-T import against the environment's own observations, and against the real recordings where they are."""

import sys
import zipfile
from pathlib import Path

import gym_pusht  # noqa: F401
import gymnasium as gym
import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli import import_pusht as command
from lerobot_agpd.cli.import_pusht import ImportPushTConfig, import_pusht
from lerobot_agpd.envs.pusht_recordings import block_geometry, load_arrays
from lerobot_agpd.flag_checks import FlagError

DATA = Path(__file__).parents[3] / "shared" / "data"
REAL, REAL_IMAGES = DATA / "pusht_human_lowdim.npz", DATA / "pusht_human_images.npz"
ENDS = (3, 4, 9)
GOAL = (256.0, 256.0, np.pi / 4)


@pytest.fixture
def source(tmp_path) -> Path:
    rng = np.random.default_rng(0)
    path = tmp_path / "pusht.npz"
    state = rng.uniform(100, 400, (9, 5)).astype(np.float32)
    np.savez(
        path,
        state=state,
        action=rng.uniform(0, 512, (9, 2)).astype(np.float32),
        img=rng.integers(0, 255, (9, 96, 96, 3), dtype=np.uint8),
        episode_ends=np.array(ENDS),
    )
    return path


@pytest.fixture
def buffer(source, tmp_path) -> Path:
    """The same arrays as Diffusion Policy stores them: zarr v2, compressed by Blosc, images as floats."""
    zarr = pytest.importorskip("zarr")
    from numcodecs import Blosc

    path = tmp_path / "pusht_replay.zarr"
    group = zarr.open_group(path, mode="w", zarr_format=2)
    blosc = Blosc(cname="zstd", clevel=5, shuffle=Blosc.BITSHUFFLE)
    with np.load(source) as arrays:
        for key in arrays.files:
            name = f"meta/{key}" if key == "episode_ends" else f"data/{key}"
            values = arrays[key].astype(np.float32) if key == "img" else arrays[key]
            # Chunks of four rows: neither the episodes nor the array end where a chunk does.
            chunks = (min(4, len(values)), *values.shape[1:])
            stored = group.create_array(
                name, shape=values.shape, dtype=values.dtype, chunks=chunks, compressors=blosc
            )
            stored[:] = values
    return path


def zipped(folder: Path, inside: str) -> Path:
    """Zip file of a folder, whose files lie in the folder `inside` of it."""
    path = folder.with_suffix(".zip")
    with zipfile.ZipFile(path, "w") as archive:
        for file in folder.rglob("*"):
            if file.is_file():
                archive.write(file, Path(inside) / file.relative_to(folder))
    return path


def test_block_geometry_is_the_environments_own():
    env = gym.make("gym_pusht/PushT-v0", obs_type="environment_state_agent_pos")
    env.reset(seed=0)
    inner = env.unwrapped
    for state in ([200, 150, 300, 260, 1.2], [100, 400, 150, 350, -2.0], [100, 100, 250, 240, 0.7]):
        env.reset(options={"reset_to_state": state})
        pose = [*inner.block.position, inner.block.angle]
        shown = inner.get_obs()["environment_state"]
        keypoints, coverage = block_geometry(np.array([pose]))
        np.testing.assert_allclose(keypoints[0], shown, rtol=1e-5)
        assert coverage[0] == pytest.approx(inner._get_coverage(), abs=1e-9)
    assert 0 < coverage[0] < 1


def test_block_on_the_target_covers_it():
    _, coverage = block_geometry(np.array([GOAL, (100.0, 100.0, 0.0)]))
    np.testing.assert_allclose(coverage, [1, 0], atol=1e-9)


def test_reward_and_success_are_those_of_the_next_state(tmp_path):
    far, near = (100.0, 100.0, 0.0), GOAL
    state = np.array([(50, 50, *pose) for pose in (far, near, far, far, near)], dtype=np.float32)
    path = tmp_path / "pusht.npz"
    np.savez(path, state=state, action=np.zeros((5, 2)), episode_ends=np.array([3, 5]))
    frames = list(import_pusht(ImportPushTConfig(source=path, root=tmp_path / "data")))
    assert [frame["next.success"].item() for frame in frames] == [True, False, False, True, True]
    assert [frame["next.reward"].item() for frame in frames] == [1, 0, 0, 1, 1]
    assert [frame["next.done"].item() for frame in frames] == [False, False, True, False, True]


@pytest.mark.parametrize("form", ["folder", "parent folder", "zip", "nested zip"])
def test_replay_buffer_holds_what_the_npz_holds(source, buffer, tmp_path, form):
    path = {
        "folder": lambda: buffer,
        "parent folder": lambda: buffer.parent,
        "zip": lambda: zipped(buffer, "."),
        "nested zip": lambda: zipped(buffer, "pusht/pusht_replay.zarr"),
    }[form]()
    expected = load_arrays(source, with_images=True)
    arrays = load_arrays(path, with_images=True)
    assert set(arrays) == set(expected) == {"state", "action", "img", "episode_ends"}
    for key, values in expected.items():
        np.testing.assert_array_equal(arrays[key], values)
    assert arrays["img"].dtype == np.uint8


def test_images_are_left_unread_unless_needed(buffer):
    assert "img" not in load_arrays(buffer)


def test_replay_buffer_is_imported(buffer, tmp_path):
    dataset = import_pusht(ImportPushTConfig(source=buffer, root=tmp_path / "data"))
    assert [dataset.num_episodes, dataset.num_frames] == [3, 9]


def test_missing_zarr_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lerobot_policy_agpd\[zarr\]'"):
        load_arrays(tmp_path)


def test_folder_without_a_replay_buffer_is_refused(tmp_path):
    pytest.importorskip("zarr")
    with pytest.raises(ValueError, match="no replay buffer.*meta/episode_ends"):
        load_arrays(tmp_path)


def test_state_variant_holds_the_block_pose(source, tmp_path):
    dataset = import_pusht(ImportPushTConfig(source=source, root=tmp_path / "data", variant="state"))
    with np.load(source) as arrays:
        poses = [item["observation.environment_state"].numpy() for item in dataset]
        np.testing.assert_array_equal(poses, arrays["state"][:, 2:])


def test_the_first_episodes_are_imported_without_loss(source, tmp_path):
    dataset = import_pusht(ImportPushTConfig(source=source, root=tmp_path / "data", first_episodes=2))
    arrays = load_arrays(source)
    assert [dataset.num_episodes, dataset.num_frames] == [2, 4]
    for row, item in enumerate(dataset):
        np.testing.assert_array_equal(item["observation.state"], arrays["state"][row, :2])
        np.testing.assert_array_equal(item["action"], arrays["action"][row])
        assert item["episode_index"] == (0 if row < 3 else 1)


def test_images(source, tmp_path):
    config = ImportPushTConfig(source=source, root=tmp_path / "data", variant="image", first_episodes=1)
    dataset = import_pusht(config)
    with np.load(source) as arrays:
        shown = (dataset[1]["observation.image"] * 255).round().permute(1, 2, 0).numpy()
        np.testing.assert_array_equal(shown, arrays["img"][1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"first_episodes": 0}, "--first_episodes .* 0"),
        ({"first_episodes": -3}, "--first_episodes .* -3"),
        ({"first_episodes": 4}, "--first_episodes=4: .* has 3 episodes"),
    ],
)
def test_episodes_that_are_not_there_are_refused(source, tmp_path, options, message):
    with pytest.raises((FlagError, ValueError), match=message):
        import_pusht(ImportPushTConfig(source=source, root=tmp_path / "data", **options))
    assert not list(tmp_path.glob("data*"))


def test_folders_that_are_wrong_are_refused(source, tmp_path):
    with pytest.raises(FlagError, match="--source="):
        ImportPushTConfig(source=tmp_path / "nothing.npz", root=tmp_path / "data")
    with pytest.raises(FlagError, match="--images="):
        ImportPushTConfig(source=source, images=tmp_path / "nothing.npz", root=tmp_path / "data")
    with pytest.raises(FlagError, match="--root="):
        ImportPushTConfig(source=source, root=tmp_path)


def test_unknown_variant_is_refused_with_the_known_ones(source, tmp_path, monkeypatch, capsys):
    argv = ["command", f"--source={source}", f"--root={tmp_path / 'data'}", "--variant=pixels"]
    monkeypatch.setattr(sys, "argv", argv)
    with pytest.raises(SystemExit):
        command.main()
    error = capsys.readouterr().err
    assert all(word in error for word in ("--variant", "pixels", "keypoints", "state", "image"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: {"something": np.zeros(3)}, r"no array \['state', 'action', 'episode_ends', 'img'\]"),
        (lambda a: {k: v for k, v in a.items() if k != "episode_ends"}, r"no array \['episode_ends'\]"),
        (lambda a: {**a, "episode_ends": np.array([3, 3, 9])}, "episode_ends must rise"),
        (lambda a: {**a, "episode_ends": np.array([4, 3, 9])}, "episode_ends must rise"),
        (lambda a: {**a, "episode_ends": np.array([0, 3, 9])}, "episode_ends must rise"),
        (lambda a: {**a, "episode_ends": np.array([3, 4, 12])}, "episode_ends reaches row 12, .* have 9"),
        (lambda a: {**a, "episode_ends": np.array([3.0, 9.0])}, "episode_ends must be row numbers"),
        (lambda a: {**a, "episode_ends": np.array([], dtype=int)}, "episode_ends must be row numbers"),
        (lambda a: {**a, "action": a["action"][:5]}, r"action has shape \(5, 2\), expected \(9, 2\)"),
        (lambda a: {**a, "state": np.where(a["state"] == a["state"][4, 1], np.nan, a["state"])}, "state .* row 4"),
        (lambda a: {**a, "img": a["img"][:, :, :, 0]}, "img must be images"),
        (lambda a: {**a, "img": a["img"] * 2.0}, r"img must lie in \[0, 1\] or \[0, 255\]"),
        (lambda a: {**a, "img": a["img"] / 255.0 - 0.5}, "img must lie in"),
        (lambda a: {**a, "img": a["img"] * np.nan}, "img must lie in"),
    ],
)  # fmt: skip
def test_arrays_that_do_not_fit_are_named(source, tmp_path, change, message):
    with np.load(source) as arrays:
        changed = change(dict(arrays))
    path = tmp_path / "changed.npz"
    np.savez(path, **changed)
    with pytest.raises(ValueError, match=message) as raised:
        import_pusht(ImportPushTConfig(source=path, root=tmp_path / "data", variant="image"))
    assert str(path) in str(raised.value)
    assert not list(tmp_path.glob("data*"))


@pytest.mark.parametrize("scale", [1, 1 / 255], ids=["in [0, 255]", "in [0, 1]"])
def test_images_may_be_floats(source, tmp_path, scale):
    with np.load(source) as arrays:
        path = tmp_path / "float.npz"
        np.savez(path, **{**arrays, "img": (arrays["img"] * scale).astype(np.float32)})
        np.testing.assert_array_equal(load_arrays(path, with_images=True)["img"], arrays["img"])


def test_what_is_no_npz_file_is_refused(tmp_path):
    path = tmp_path / "text.npz"
    path.write_text("not an archive")
    with pytest.raises(ValueError, match="text.npz"):
        load_arrays(path)


@pytest.mark.skipif(not REAL.exists(), reason="the human recordings are not at hand")
def test_the_human_recordings(tmp_path):
    dataset = import_pusht(ImportPushTConfig(source=REAL, root=tmp_path / "data", first_episodes=3))
    with np.load(REAL) as arrays:
        assert dataset.num_frames == arrays["episode_ends"][2]
        assert LeRobotDataset("x", root=tmp_path / "data").fps == 10
        np.testing.assert_array_equal(dataset[100]["action"], arrays["action"][100])
        rewards = np.array([frame["next.reward"].item() for frame in dataset])
        assert rewards.max() > 0.9  # people bring the block to the target


@pytest.mark.skipif(not REAL_IMAGES.exists(), reason="the human recordings are not at hand")
def test_the_human_recordings_as_images(tmp_path):
    config = ImportPushTConfig(
        source=REAL, images=REAL_IMAGES, root=tmp_path / "data", variant="image", first_episodes=1
    )
    dataset = import_pusht(config)
    with np.load(REAL_IMAGES) as arrays:
        shown = (dataset[7]["observation.image"] * 255).round().permute(1, 2, 0).numpy()
        np.testing.assert_array_equal(shown, arrays["img"][7])
