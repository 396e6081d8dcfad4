"""The page about interrupted runs names tests that exist."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_way_to_stop_has_its_test():
    text = (ROOT / "docs" / "interrupted.md").read_text()
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text)
    rows = [line for line in text.splitlines() if line.startswith("|")][2:]
    assert len(named) > len(rows) > 10 and all("::" in row for row in rows)
    for path, test in named:
        assert f"def {test}(" in (ROOT / path).read_text(), f"{path} has no {test}"
