"""Files of robomimic's schema, and one of them imported."""

import sys
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli import import_robomimic as command


@pytest.fixture(scope="session")
def rollouts() -> list:
    """Four demonstrations of random numbers, two of which succeed."""
    pytest.importorskip("h5py")
    from robomimic_files import LENGTHS, random_rollout

    return [random_rollout(i, length, success=i < 2) for i, length in enumerate(LENGTHS)]


@pytest.fixture(scope="session")
def source(rollouts, tmp_path_factory) -> Path:
    from robomimic_files import write

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


@pytest.fixture(scope="session")
def images(tmp_path_factory) -> tuple[Path, list]:
    """Two demonstrations of two steps, seen by two cameras of 64 pixels."""
    pytest.importorskip("h5py")
    from robomimic_files import random_rollout, write

    played = [random_rollout(i, 2, True, ("agentview", "robot0_eye_in_hand")) for i in range(2)]
    return write(tmp_path_factory.mktemp("images") / "image_v15.hdf5", played), played
