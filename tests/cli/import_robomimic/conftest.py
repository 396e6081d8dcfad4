"""Files of real robosuite rollouts, and one of them imported."""

import sys
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli import import_robomimic as command


@pytest.fixture(scope="session")
def rollouts() -> list:
    """Two demonstrations that lift the cube, and two too short for it."""
    pytest.importorskip("h5py")
    pytest.importorskip("robosuite")
    from robomimic_files import LENGTHS, make_lift, record

    env = make_lift()
    played = [record(env, seed, n_steps) for seed, n_steps in enumerate(LENGTHS)]
    env.close()
    return played


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
def images(rendering, tmp_path_factory) -> tuple[Path, list]:
    """Two demonstrations of two steps, seen by two cameras of 64 pixels."""
    pytest.importorskip("h5py")
    pytest.importorskip("robosuite")
    from robomimic_files import make_lift, part, record, write

    env = make_lift(cameras=("agentview", "robot0_eye_in_hand"), size=64)
    rollout = record(env, 0, 4)
    env.close()
    played = [part(rollout, 0, 2), part(rollout, 2, 4)]
    return write(tmp_path_factory.mktemp("images") / "image_v15.hdf5", played), played
