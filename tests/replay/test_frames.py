"""The gather against LeRobot's own `delta_timestamps`."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.sampler import EpisodeAwareSampler

from lerobot_agpd.replay.frames import ChunkStarts, FrameTable
from lerobot_agpd.replay.growing import GrowingTensor

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
    table = FrameTable({"x": torch.arange(5.0)[:, None]}, [2, 3])
    values, is_pad = table.gather("x", torch.tensor([1, 2, 1]), torch.tensor([-1, 0, 1, 2]))
    assert values[..., 0].tolist() == [[0, 1, 1, 1], [2, 2, 3, 4], [0, 1, 1, 1]]
    assert is_pad.int().tolist() == [[0, 0, 1, 1], [1, 0, 0, 0], [0, 0, 1, 1]]
    assert [bound.tolist() for bound in table.episode_bounds(torch.arange(5))] == [
        [0, 0, 2, 2, 2],
        [2, 2, 5, 5, 5],
    ]
    assert table.episode(torch.arange(5)).tolist() == [0, 0, 1, 1, 1] and table.lengths.tolist() == [2, 3]


# ---- growth ----


def filled(lengths, first=0.0):
    return torch.arange(first, first + sum(lengths))[:, None].expand(-1, 2)


def test_appended_episodes_stay_apart_and_frames_keep_their_numbers():
    table = FrameTable({"x": torch.arange(3.0)[:, None]}, [1, 2])
    before = [table.gather("x", torch.tensor([row]), torch.tensor([-2, 0, 2])) for row in range(3)]
    table.append({"x": torch.arange(10.0, 12.0)[:, None]}, [2])
    assert len(table) == 5
    values, is_pad = table.gather("x", torch.arange(5), torch.tensor([-1, 1]))
    assert values[..., 0].tolist() == [[0, 0], [1, 2], [1, 2], [10, 11], [10, 11]]
    assert is_pad.int().tolist() == [[1, 1], [1, 0], [0, 1], [1, 0], [0, 1]]
    for row, (values, is_pad) in enumerate(before):
        again = table.gather("x", torch.tensor([row]), torch.tensor([-2, 0, 2]))
        assert torch.equal(again[0], values) and torch.equal(again[1], is_pad)


@given(
    lengths=st.lists(st.lists(st.integers(1, 9), min_size=1, max_size=4), min_size=1, max_size=6),
    deltas=st.lists(st.integers(-12, 12), min_size=1, max_size=5),
)
@settings(deadline=None)
def test_property_a_grown_table_is_one_built_at_once(lengths, deltas):
    table = FrameTable({"x": filled(lengths[0])}, lengths[0])
    for part in lengths[1:]:
        table.append({"x": filled(part, float(len(table)))}, part)
    flat = [length for part in lengths for length in part]
    whole = FrameTable({"x": filled(flat)}, flat)
    rows, offsets = torch.arange(sum(flat)), torch.tensor(deltas)
    for ours, theirs in zip(table.gather("x", rows, offsets), whole.gather("x", rows, offsets), strict=True):
        assert torch.equal(ours, theirs)
    bounds = [(end - length, end) for length, end in zip(flat, np.cumsum(flat), strict=True)]
    steps = [
        (row, delta, *bounds[int(table.episode(torch.tensor([row])))])
        for row in rows.tolist()
        for delta in deltas
    ]
    values, is_pad = table.gather("x", rows, offsets)
    assert values[..., 0].flatten().tolist() == [min(max(r + d, lo), hi - 1) for r, d, lo, hi in steps]
    assert is_pad.flatten().tolist() == [not lo <= r + d < hi for r, d, lo, hi in steps]


@pytest.mark.parametrize("n_frames", [1_000, 1_000_000])
def test_appending_copies_what_is_new_and_seldom_the_rest(n_frames):
    """Counted in reallocations, each of which copies the table: the same whatever its size."""
    table = FrameTable({"x": torch.zeros(n_frames, 4)}, [n_frames])
    table.append({"x": torch.zeros(n_frames // 100, 4)}, [n_frames // 100])  # the first growth
    places = set()
    for _ in range(40):
        table.append({"x": torch.zeros(n_frames // 100, 4)}, [n_frames // 100])
        places.add(table.columns["x"].data_ptr())
    assert len(table) == n_frames + 41 * (n_frames // 100) and len(places) == 1


@pytest.mark.parametrize("dims", [{"action": 2, "state": 5}, {"action": 14, "state": 14}])
def test_a_frame_takes_at_most_twice_its_bytes(dims):
    table = FrameTable({key: torch.zeros(10, dim) for key, dim in dims.items()}, [10])
    for length in [37] * 200:
        table.append({key: torch.zeros(length, dim) for key, dim in dims.items()}, [length])
        raw = len(table) * 4 * sum(dims.values())
        assert table.nbytes <= 2 * raw


def test_growing_keeps_rows_and_dtype():
    tensor = GrowingTensor((2,), torch.int32)
    assert tensor.values.shape == (0, 2)
    for start in range(0, 30, 3):
        tensor.append(torch.arange(start, start + 3)[:, None].expand(-1, 2))
    tensor.grow(4)[:] = -1
    assert tensor.values.dtype == torch.int32 and len(tensor) == 34
    assert tensor.values[:, 1].tolist() == [*range(30), -1, -1, -1, -1]
    sizes = set()
    for _ in range(2_000):
        tensor.grow(1)
        sizes.add(tensor.nbytes)
    assert len(sizes) < 15, "2000 rows, a handful of reallocations"


# ---- where chunks begin ----


def starts(lengths, n_dropped):
    found, first = ChunkStarts(n_dropped), 0
    for length in lengths:
        found.append(first, length)
        first += length
    return found


@pytest.mark.parametrize("n_dropped", [0, 1, 2, 3, 6])
def test_starts_are_those_of_lerobots_sampler(demonstrations, table, n_dropped):
    sides = (demonstrations.meta.episodes[f"dataset_{side}_index"] for side in ("from", "to"))
    sampler = EpisodeAwareSampler(*sides, drop_n_last_frames=n_dropped)
    found = starts(table.lengths.tolist(), n_dropped)
    assert found.frames(torch.arange(len(found))).tolist() == sampler.indices


@given(st.lists(st.integers(1, 9), max_size=12), st.integers(0, 6))
def test_property_starts_are_all_but_the_last_frames_in_order(lengths, n_dropped):
    found = starts(lengths, n_dropped)
    ends = np.cumsum(lengths, dtype=int)
    expected = [
        frame
        for length, end in zip(lengths, ends, strict=True)
        for frame in range(end - length, end - n_dropped)
    ]
    assert len(found) == len(expected)
    assert not expected or found.frames(torch.arange(len(found))).tolist() == expected


# ---- what does not fit ----


def test_missing_feature_is_named(demonstrations):
    with pytest.raises(KeyError, match="observation.torque"):
        FrameTable.from_dataset(demonstrations, ["action", "observation.torque"])


def test_partly_loaded_dataset_is_refused(demonstrations):
    selected = LeRobotDataset(demonstrations.repo_id, root=demonstrations.root, episodes=[2])
    with pytest.raises(ValueError, match="order of their index"):
        FrameTable.from_dataset(selected, KEYS)


def test_columns_must_fit():
    with pytest.raises(ValueError, match="'x' has 4 frames, the episodes 5"):
        FrameTable({"x": torch.zeros(4, 1)}, [2, 3])
    table = FrameTable({"x": torch.zeros(2, 1)}, [2])
    with pytest.raises(ValueError, match="columns differ"):
        table.append({"y": torch.zeros(2, 1)}, [2])
    with pytest.raises(ValueError, match="'x' has shape"):
        table.append({"x": torch.zeros(2, 3)}, [2])
    assert len(table) == 2
