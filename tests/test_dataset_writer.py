"""The one way to write a LeRobotDataset: complete or not at all, and resumable where there is a plan."""

import gc

import numpy as np
import pytest

from lerobot_agpd.dataset_writer import DatasetWriter, flag, vector

FEATURES = {"observation.state": vector(2), "action": vector(1), "next.done": flag()}


def episode(number: int, length: int = 3):
    for step in range(length):
        yield {
            "observation.state": np.float32([number, step]),
            "action": np.float32([number]),
            "next.done": np.array([step == length - 1]),
            "task": "a task",
        }


def writer(tmp_path, **options) -> DatasetWriter:
    return DatasetWriter(tmp_path / "nested" / "data", "local/data", 10, FEATURES, **options)


def states(dataset) -> np.ndarray:
    return np.stack(dataset.hf_dataset.with_format("numpy")[:]["observation.state"])


def everything(n_episodes: int) -> np.ndarray:
    return np.stack([frame["observation.state"] for number in range(n_episodes) for frame in episode(number)])


@pytest.mark.parametrize("options", [{}, {"plan": {"source": "x"}, "episodes_per_shard": 2}])
def test_all_frames_are_there_and_nothing_else_is_left(tmp_path, options):
    done = []
    dataset = writer(tmp_path, robot_type="arm", **options).write(
        map(episode, range(5)), lambda: done.append(0)
    )
    assert (dataset.num_episodes, dataset.fps, dataset.meta.robot_type) == (5, 10, "arm")
    np.testing.assert_array_equal(states(dataset), everything(5))
    assert len(done) == 5
    assert [path.name for path in (tmp_path / "nested").iterdir()] == ["data"]


def test_files_are_added_before_the_dataset_has_its_name(tmp_path):
    def add(folder):
        assert not (tmp_path / "nested/data").exists()
        (folder / "meta/report.json").write_text("{}")

    dataset = writer(tmp_path).write([episode(0)], add_files=add)
    assert (dataset.root / "meta/report.json").exists()


def interrupted(n_episodes: int, error: BaseException):
    """Episodes of which the last one breaks off."""

    def broken():
        yield next(episode(n_episodes - 1))
        raise error

    return [*map(episode, range(n_episodes - 1)), broken()]


PLAN = {"plan": {"source": "x"}, "episodes_per_shard": 2}


def test_a_run_with_a_plan_goes_on(tmp_path):
    error = OSError("disk full")
    with pytest.raises(OSError):
        writer(tmp_path, **PLAN).write(interrupted(4, error))
    begun = []

    def counted(number):
        begun.append(number)
        yield from episode(number)

    done = []
    dataset = writer(tmp_path, **PLAN).write(map(counted, range(5)), lambda: done.append(0))
    assert begun == [2, 3, 4]  # the finished shard holds 0 and 1
    assert len(done) == 5
    np.testing.assert_array_equal(states(dataset), everything(5))


def test_an_interruption_while_files_are_added_is_survived(tmp_path):
    def die(folder):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        writer(tmp_path, **PLAN).write(map(episode, range(3)), add_files=die)
    assert not (tmp_path / "nested/data").exists()
    np.testing.assert_array_equal(
        states(writer(tmp_path, **PLAN).write(map(episode, range(3)))), everything(3)
    )


@pytest.mark.parametrize(
    ("options", "error"), [(PLAN, ValueError("wrong")), ({}, ValueError("wrong")), ({}, KeyboardInterrupt())]
)
def test_nothing_is_left_where_nothing_can_go_on(tmp_path, options, error):
    try:
        writer(tmp_path, **options).write(interrupted(4, error))
    except type(error):
        del error
    gc.collect()  # what LeRobot writes when a dataset is collected
    assert not list((tmp_path / "nested").iterdir())


@pytest.mark.parametrize("options", [{}, PLAN])
def test_no_episode_is_refused(tmp_path, options):
    with pytest.raises(ValueError, match="no episode"):
        writer(tmp_path, **options).write([])
    assert not list((tmp_path / "nested").iterdir())


def test_another_plan_does_not_go_on(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        writer(tmp_path, **PLAN).write(interrupted(4, KeyboardInterrupt()))
    with pytest.raises(FileExistsError, match="source was x, is now y"):
        writer(tmp_path, plan={"source": "y"}, episodes_per_shard=2).write([episode(0)])
    with pytest.raises(FileExistsError, match="episodes_per_shard was 2, is now 3"):
        writer(tmp_path, plan=PLAN["plan"], episodes_per_shard=3).write([episode(0)])
    assert (tmp_path / "nested/data.partial").exists()


def test_without_a_plan_every_run_starts_anew(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        writer(tmp_path, **PLAN).write(interrupted(4, KeyboardInterrupt()))
    assert writer(tmp_path).write([episode(0)]).num_episodes == 1
    assert not (tmp_path / "nested/data.partial").exists()


def test_folders_of_others_are_left_alone(tmp_path):
    other = tmp_path / "nested/data.partial/notes.txt"
    other.parent.mkdir(parents=True)
    other.touch()
    with pytest.raises(FileExistsError, match=r"data\.partial"):
        writer(tmp_path).write([episode(0)])
    other.unlink()
    other.parent.rmdir()
    (tmp_path / "nested/data").mkdir()
    with pytest.raises(FileExistsError, match="already exists"):
        writer(tmp_path).write([episode(0)])
