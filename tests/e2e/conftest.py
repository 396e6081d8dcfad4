"""Demonstrations and teacher of the end-to-end tests: those of FetchPickAndPlace in examples/."""

import os
from pathlib import Path

import pytest
from commands import EXAMPLES

os.environ.setdefault("MUJOCO_GL", "egl")  # before anything renders

PICK_AND_PLACE = EXAMPLES / "fetch_pick_and_place"


@pytest.fixture
def fetch_demos() -> Path:
    """Ten expert episodes of FetchPickAndPlace."""
    return PICK_AND_PLACE / "demonstrations"


@pytest.fixture
def fetch_teacher() -> Path:
    """A diffusion teacher that picks and places."""
    return PICK_AND_PLACE / "teacher"
