"""The README's example from Python is the example's own code."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_readme_shows_the_example() -> None:
    source = (ROOT / "examples/train_fetchreach.py").read_text()
    (main,) = [node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)]
    assert f"```python\n{ast.get_source_segment(source, main)}\n```" in (ROOT / "README.md").read_text()
