"""Demonstrations and teachers of the end-to-end tests, made by the project's own commands."""

from pathlib import Path

import pytest
from commands import REACH, TINY_TEACHER, dataset_flags, run


@pytest.fixture(scope="session")
def reach_demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve expert episodes of FetchReach."""
    root = tmp_path_factory.mktemp("data") / "reach"
    run("lerobot-agpd-demos", *REACH, "--episodes=12", "--seed=0", f"--root={root}", "--repo_id=local/test")
    return root


@pytest.fixture(scope="session")
def reach_teacher(reach_demos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small diffusion teacher that reaches."""
    output = tmp_path_factory.mktemp("teacher") / "run"
    run("lerobot-train", *TINY_TEACHER, *dataset_flags(reach_demos), "--steps=400", f"--output_dir={output}")
    return output / "checkpoints" / "last" / "pretrained_model"
