"""Demonstrations and teacher of the end-to-end tests: the quickstart's."""

import os
from pathlib import Path

import pytest
from commands import EXAMPLES

os.environ.setdefault("MUJOCO_GL", "egl")  # before anything renders

QUICKSTART = EXAMPLES / "quickstart"


@pytest.fixture
def fetch_demos() -> Path:
    """Ten expert episodes of FetchPickAndPlace."""
    return QUICKSTART / "demonstrations"


@pytest.fixture
def fetch_teacher() -> Path:
    """A diffusion teacher that picks and places."""
    return QUICKSTART / "teacher"
