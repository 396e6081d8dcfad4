"""Files that are never half written, and never trusted if they are."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def write_text(path: Path, text: str) -> None:
    """Write a file that is either old or new, never half of it."""
    partial = path.with_name(f"{path.name}.partial")
    with partial.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON atomically."""
    write_text(path, json.dumps(content, default=str) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read JSON.

    Raises:
        ValueError: if the file is damaged.
    """
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(
            f"{path} is damaged ({error}); remove it and run the comparison again: what it held is made anew"
        ) from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged (no object); remove it and run the comparison again")
    return content
