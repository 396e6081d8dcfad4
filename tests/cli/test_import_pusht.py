"""The Push-T import against the environment's own observations, and against the real recordings where they are."""

from pathlib import Path

import gym_pusht  # noqa: F401
import gymnasium as gym
import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli.import_pusht import ImportPushTConfig, block_keypoints, import_pusht, load_arrays

REAL = Path(__file__).parents[3] / "shared" / "data" / "pusht_human_lowdim.npz"
ENDS = (3, 4, 9)


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


def test_keypoints_are_the_environments_own():
    env = gym.make("gym_pusht/PushT-v0", obs_type="environment_state_agent_pos")
    env.reset(seed=0)
    inner = env.unwrapped
    for state in ([200, 150, 300, 260, 1.2], [100, 400, 150, 350, -2.0]):
        env.reset(options={"reset_to_state": state})
        pose = [*inner.block.position, inner.block.angle]
        shown = inner.get_obs()["environment_state"]
        np.testing.assert_allclose(block_keypoints(np.array([pose]))[0], shown, rtol=1e-5)


def test_chosen_episodes_are_imported_without_loss(source, tmp_path):
    dataset = import_pusht(ImportPushTConfig(source=source, root=tmp_path / "data", episodes=[0, 2]))
    arrays = load_arrays(ImportPushTConfig(source=source, root=tmp_path / "other"))
    assert [dataset.num_episodes, dataset.num_frames] == [2, 8]
    rows = [0, 1, 2, 4, 5, 6, 7, 8]
    for item, row in zip(dataset, rows, strict=True):
        np.testing.assert_array_equal(item["observation.state"], arrays["state"][row, :2])
        np.testing.assert_array_equal(item["action"], arrays["action"][row])
        assert item["episode_index"] == (0 if row < 3 else 1)


def test_images(source, tmp_path):
    config = ImportPushTConfig(source=source, root=tmp_path / "data", variant="images", first_episodes=1)
    dataset = import_pusht(config)
    with np.load(source) as arrays:
        shown = (dataset[1]["observation.image"] * 255).round().permute(1, 2, 0).numpy()
        np.testing.assert_array_equal(shown, arrays["img"][1])


def test_wrong_input_is_named(source, tmp_path):
    with pytest.raises(FileNotFoundError, match="--source="):
        ImportPushTConfig(source=tmp_path / "nothing.npz", root=tmp_path / "data")
    with pytest.raises(FileExistsError, match="--root="):
        ImportPushTConfig(source=source, root=tmp_path)
    with pytest.raises(ValueError, match="--variant"):
        ImportPushTConfig(source=source, root=tmp_path / "data", variant="pixels")
    with pytest.raises(ValueError, match="episode 7 was asked for, .* has 3"):
        import_pusht(ImportPushTConfig(source=source, root=tmp_path / "data", episodes=[7]))
    np.savez(tmp_path / "foreign.npz", something=np.zeros(3))
    with pytest.raises(
        KeyError, match=r"no array \['state', 'action', 'episode_ends'\]; found \['something'\]"
    ):
        load_arrays(ImportPushTConfig(source=tmp_path / "foreign.npz", root=tmp_path / "data"))


@pytest.mark.skipif(not REAL.exists(), reason="the human recordings are not at hand")
def test_the_human_recordings(tmp_path):
    dataset = import_pusht(ImportPushTConfig(source=REAL, root=tmp_path / "data", first_episodes=3))
    with np.load(REAL) as arrays:
        assert dataset.num_frames == arrays["episode_ends"][2]
        assert LeRobotDataset("x", root=tmp_path / "data").fps == 10
        np.testing.assert_array_equal(dataset[100]["action"], arrays["action"][100])
