"""Imports of robomimic's files that are killed go on where they were."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("h5py")

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata  # noqa: E402
from robomimic_files import column, part, run_import, write  # noqa: E402

from lerobot_agpd.cli import import_robomimic as command  # noqa: E402
from lerobot_agpd.envs.robomimic_columns import RobomimicColumns  # noqa: E402


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

    written, create = [], LeRobotDatasetMetadata.create

    def note(*args, **kwargs):
        meta = create(*args, **kwargs)
        written.append(meta.root.name)
        return meta

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LeRobotDatasetMetadata, "create", note)
        dataset = run_import(source, root, episodes_per_shard=2)
    assert written.count("unfinished") == 20 - len(finished), "the name of a shard until it is whole"
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


@pytest.mark.slow
def test_import_killed_while_merging_goes_on(source, tmp_path, monkeypatch):
    def die(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "copy_recordings", die)
    with pytest.raises(KeyboardInterrupt):
        run_import(source, tmp_path / "data", episodes_per_shard=2)
    assert (tmp_path / "data.partial/merged").exists() and not (tmp_path / "data").exists()
    monkeypatch.undo()
    monkeypatch.setattr(RobomimicColumns, "read", die)  # nothing is read again
    assert run_import(source, tmp_path / "data", episodes_per_shard=2).num_episodes == 4


def test_another_file_or_option_does_not_continue(source, rollouts, tmp_path, monkeypatch):
    def die(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(RobomimicColumns, "read", die)
    with pytest.raises(KeyboardInterrupt):
        run_import(source, tmp_path / "data", episodes=[0, 1])
    monkeypatch.undo()
    with pytest.raises(FileExistsError, match=r"demos was .*'demo_1'\], is now .*'demo_2'\]"):
        run_import(source, tmp_path / "data", episodes=[0, 2])
    other = write(tmp_path / "other.hdf5", rollouts[2:])
    with pytest.raises(FileExistsError, match="source was"):
        run_import(other, tmp_path / "data", episodes=[0, 1])
