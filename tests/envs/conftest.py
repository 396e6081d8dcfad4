"""Fixtures shared by the environments' tests."""

import pytest


@pytest.fixture(scope="session")
def rendering() -> None:
    """Skip tests that need images where MuJoCo cannot open a graphics context."""
    mujoco = pytest.importorskip("mujoco")
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # whatever the graphics library raises
        pytest.skip(f"no graphics context (is MUJOCO_GL set?): {error}")
