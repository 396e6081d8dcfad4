"""Episodes written as one table are the dataset that LeRobot's recorder writes."""

import numpy as np
import pytest
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.dataset_table import EpisodeTable
from lerobot_agpd.dataset_writer import flag, vector

FEATURES = {
    "observation.state": vector(3),
    "action": vector(2),
    "next.reward": vector(1),
    "next.done": flag(),
    "round": {"dtype": "int64", "shape": (1,), "names": None},
    "strategy": {"dtype": "string", "shape": (1,), "names": None},
    "grid": {"dtype": "float32", "shape": (2, 2), "names": None},
}


def episode(number: int):
    rng = np.random.default_rng(number)
    for step in range(4 + 3 * number):
        yield {
            "observation.state": rng.normal(size=3).astype(np.float32),
            "action": rng.normal(size=2).astype(np.float32),
            "next.reward": np.float32([step]),
            "next.done": np.array([step == 3]),
            "round": np.array([number]),
            "strategy": "guided" if number % 2 else "teacher",
            "grid": rng.normal(size=(2, 2)).astype(np.float32),
            "task": f"task {number % 2}",
        }


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> LeRobotDataset:
    root = tmp_path_factory.mktemp("recorded") / "data"
    dataset = LeRobotDataset.create("local/x", 10, FEATURES, root, robot_type="arm", use_videos=False)
    for number in range(5):
        for frame in episode(number):
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/x", root=root)


def table(root, **options) -> EpisodeTable:
    return EpisodeTable(
        LeRobotDatasetMetadata.create("local/x", 10, FEATURES, "arm", root, use_videos=False, **options)
    )


def written(root, **options) -> LeRobotDataset:
    new = table(root, **options)
    for number in range(5):
        new.add(episode(number))
    new.finish()
    return LeRobotDataset("local/x", root=root)


def assert_same(ours, theirs) -> None:
    assert set(ours) == set(theirs)
    for key, values in theirs.items():
        np.testing.assert_array_equal(np.asarray(ours[key]), np.asarray(values), err_msg=key)


def test_frames_metadata_and_statistics_are_those_of_a_recording(recorded, tmp_path):
    dataset = written(tmp_path / "data")
    assert dataset.meta.info == recorded.meta.info
    assert dataset.hf_dataset.features == recorded.hf_dataset.features
    assert_same(*(one.hf_dataset.with_format("numpy")[:] for one in (dataset, recorded)))
    assert_same(*(one.meta.episodes.with_format("numpy")[:] for one in (dataset, recorded)))
    assert dataset.meta.stats.keys() == recorded.meta.stats.keys()
    for key, entry in recorded.meta.stats.items():
        assert_same(dataset.meta.stats[key], entry)
    assert list(dataset.meta.tasks.index) == list(recorded.meta.tasks.index)


def test_a_full_file_is_followed_by_the_next(recorded, tmp_path):
    dataset = written(tmp_path / "data", data_files_size_in_mb=1e-6)
    assert len(list((tmp_path / "data" / "data").rglob("*.parquet"))) == 5
    assert_same(*(one.hf_dataset.with_format("numpy")[:] for one in (dataset, recorded)))
    assert all(dataset[index]["index"] == index for index in range(len(dataset)))


@pytest.mark.parametrize("wrong", [{"action": np.zeros(3, np.float32)}, {"other": 1}, {}])
def test_frames_of_other_features_are_refused(tmp_path, wrong):
    frames = list(episode(0))
    frames[1] = {**frames[1], **wrong}
    with pytest.raises(ValueError, match="action|other|frames"):
        table(tmp_path / "data").add(frames if wrong else [])
