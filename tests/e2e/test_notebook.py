"""The notebook runs from its first cell to its last, here with few training steps."""

from pathlib import Path

import pytest
from commands import EXAMPLES

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")


@pytest.mark.slow
def test_the_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STEPS", "16")
    monkeypatch.setenv("OUTPUT", str(tmp_path / "made"))
    notebook = nbformat.read(EXAMPLES / "distill.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert (tmp_path / "made" / "side_by_side.gif").read_bytes().startswith(b"GIF")
    assert notebook.cells[-1].outputs[-1].data["image/gif"]
