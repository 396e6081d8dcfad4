"""The gather against LeRobot's own `delta_timestamps`."""

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.sampler import EpisodeAwareSampler

from lerobot_agpd.replay.frames import FrameTable

FPS = 10
KEYS = ["observation.state", "observation.environment_state", "action"]


@pytest.fixture
def table(demonstrations) -> FrameTable:
    return FrameTable.from_dataset(demonstrations, KEYS)


@pytest.mark.parametrize("offsets", [[0, 1, 2, 3], [-1, 0], [-3, -1, 0, 2, 9], [-20, 20]])
def test_gather_delivers_what_lerobot_delivers(demonstrations, table, offsets):
    deltas = {key: [offset / FPS for offset in offsets] for key in KEYS}
    theirs = LeRobotDataset(demonstrations.repo_id, root=demonstrations.root, delta_timestamps=deltas)
    assert len(theirs) == len(table) == 13
    rows = torch.arange(len(table))
    gathered = {key: table.gather(key, rows, torch.tensor(offsets)) for key in KEYS}
    for row in range(len(table)):
        frame = theirs[row]
        assert int(frame["index"]) == row
        for key, (values, is_pad) in gathered.items():
            assert torch.equal(values[row], frame[key])
            assert torch.equal(is_pad[row], frame[f"{key}_is_pad"])


def test_rows_are_absolute_frame_indices_whatever_is_selected(demonstrations, table):
    selected = LeRobotDataset(demonstrations.repo_id, root=demonstrations.root, episodes=[2])
    assert len(selected) == 7
    for item in (selected[i] for i in range(7)):
        assert torch.equal(table.columns["action"][int(item["index"])], item["action"])


def test_gather_by_hand():
    table = FrameTable.from_episode_lengths({"x": torch.arange(5.0)[:, None]}, [2, 3])
    values, is_pad = table.gather("x", torch.tensor([1, 2, 1]), torch.tensor([-1, 0, 1, 2]))
    assert values[..., 0].tolist() == [[0, 1, 1, 1], [2, 2, 3, 4], [0, 1, 1, 1]]
    assert is_pad.int().tolist() == [[0, 0, 1, 1], [1, 0, 0, 0], [0, 0, 1, 1]]


@pytest.mark.parametrize("n_steps", [0, 1, 2, 3, 6])
def test_rows_before_the_end_are_those_of_lerobots_sampler(demonstrations, table, n_steps):
    sides = (demonstrations.meta.episodes[f"dataset_{side}_index"] for side in ("from", "to"))
    sampler = EpisodeAwareSampler(*sides, drop_n_last_frames=n_steps)
    assert table.rows_before_end(n_steps).tolist() == sampler.indices


def test_rows_before_the_end_by_hand():
    table = FrameTable.from_episode_lengths({"x": torch.zeros(7, 1)}, [4, 3])
    assert table.rows_before_end(0).tolist() == list(range(7))
    assert table.rows_before_end(2).tolist() == [0, 1, 4]
    assert table.rows_before_end(3).tolist() == [0], "an episode of 3 frames contributes none"
    assert table.rows_before_end(4).tolist() == []


def test_concatenation_keeps_episodes_apart():
    left = FrameTable.from_episode_lengths({"x": torch.arange(3.0)[:, None]}, [1, 2])
    right = FrameTable.from_episode_lengths({"x": torch.arange(10.0, 12.0)[:, None]}, [2])
    both = left.concatenated(right)
    assert len(both) == 5
    values, is_pad = both.gather("x", torch.arange(5), torch.tensor([-1, 1]))
    assert values[..., 0].tolist() == [[0, 0], [1, 2], [1, 2], [10, 11], [10, 11]]
    assert is_pad.int().tolist() == [[1, 1], [1, 0], [0, 1], [1, 0], [0, 1]]
    for row in range(3):  # rows of the first table keep their numbers
        ours, theirs = (t.gather("x", torch.tensor([row]), torch.tensor([-2, 0, 2])) for t in (both, left))
        assert torch.equal(ours[0], theirs[0]) and torch.equal(ours[1], theirs[1])


def test_with_columns_replaces():
    table = FrameTable.from_episode_lengths({"x": torch.zeros(2, 1)}, [2])
    changed = table.with_columns({"x": torch.ones(2, 1), "y": torch.ones(2, 3)})
    assert set(changed.columns) == {"x", "y"} and changed.columns["x"].sum() == 2
    assert table.columns["x"].sum() == 0


def test_missing_feature_is_named(demonstrations):
    with pytest.raises(KeyError, match="observation.torque"):
        FrameTable.from_dataset(demonstrations, ["action", "observation.torque"])


def test_partly_loaded_dataset_is_refused(demonstrations):
    selected = LeRobotDataset(demonstrations.repo_id, root=demonstrations.root, episodes=[2])
    with pytest.raises(ValueError, match="order of their index"):
        FrameTable.from_dataset(selected, KEYS)


def test_columns_must_fit():
    with pytest.raises(ValueError, match="'x' has 4 frames, the episodes 5"):
        FrameTable.from_episode_lengths({"x": torch.zeros(4, 1)}, [2, 3])
    left = FrameTable.from_episode_lengths({"x": torch.zeros(2, 1)}, [2])
    right = FrameTable.from_episode_lengths({"y": torch.zeros(2, 1)}, [2])
    with pytest.raises(ValueError, match="columns differ"):
        left.concatenated(right)
