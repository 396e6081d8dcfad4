"""Files that survive a crash: text, JSON, arrays, and files that grow line by line.

A reader finds the old content or the new one, never half of it.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

logger = logging.getLogger(__name__)

BLOCK_BYTES = 16 * 2**20


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write that has its name only once it is complete and on disk; for one writer at a time."""
    partial = path.with_name(f"{path.name}.partial")
    with _named_errors(partial), partial.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
    _sync_folder(path.parent)


@contextmanager
def _named_errors(path: Path) -> Iterator[None]:
    """Name the file in errors that do not: Python's own of a full disk says neither which file nor which disk."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error


def _sync_folder(folder: Path) -> None:
    """Put a new name on disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# ---- text and JSON ----


def write_text(path: Path, text: str) -> None:
    """Write a text."""
    with atomic_file(path) as file:
        file.write(text.encode())


def write_json(path: Path, content: Any, indent: int | None = None) -> None:
    """Write JSON; values that it does not have, such as paths, become strings."""
    write_text(path, json.dumps(content, default=str, indent=indent) + "\n")


def read_json(path: Path, remedy: str = "") -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming the file, if it holds anything else, with `remedy`: what to do then.
    """
    hint = f"; {remedy}" if remedy else ""
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}){hint}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged (it holds no JSON object){hint}")
    return content


# ---- files of lines ----


def append_line(path: Path, line: str) -> None:
    """Add a line and put it on disk; an incomplete last line, left by a killed process, is removed."""
    is_new = not path.exists()
    with _named_errors(path), path.open("ab+") as file:
        file.truncate(_complete_bytes(file))
        file.write(line.encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())
    if is_new:
        _sync_folder(path.parent)


def trim_incomplete_line(path: Path) -> None:
    """Remove an incomplete last line, left by a killed process, from a file that nobody writes."""
    with path.open("rb+") as file:
        size = file.seek(0, os.SEEK_END)
        complete = _complete_bytes(file)
        if complete < size:
            file.truncate(complete)
            os.fsync(file.fileno())


def _complete_bytes(file: BinaryIO) -> int:
    """Size of a file without its incomplete last line."""
    size = file.seek(0, os.SEEK_END)
    if size == 0:
        return 0
    file.seek(size - 1)
    if file.read(1) == b"\n":
        return size
    file.seek(0)
    return file.read().rfind(b"\n") + 1


def complete_lines(path: Path) -> list[str]:
    """Lines of a file without an incomplete last one, which a killed or a running process has left."""
    *lines, rest = path.read_bytes().split(b"\n")
    if rest:
        logger.warning("leaving out an incomplete line at the end of %s", path)
    return [line.decode(errors="replace") for line in lines]


# ---- arrays ----


def write_array(path: Path, columns: Array | Mapping[str, Array]) -> None:
    """Write an array, or columns (T, ...) as a structured array with one row per step, as an .npy file.

    The rows are written block by block, not through a memory map: a full disk then raises an error.
    """
    if isinstance(columns, Mapping):
        dtype = np.dtype([(key, column.dtype, column.shape[1:]) for key, column in columns.items()])
        shape: tuple[int, ...] = (len(next(iter(columns.values()))),)
    else:
        dtype, shape = columns.dtype, columns.shape
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with atomic_file(path) as file:
        np.lib.format.write_array_header_2_0(file, header)
        row_bytes = max(1, dtype.itemsize * int(np.prod(shape[1:])))
        n_rows = max(1, BLOCK_BYTES // row_bytes)
        for start in range(0, shape[0], n_rows):
            file.write(_rows(columns, dtype, slice(start, start + n_rows)).tobytes())


def _rows(columns: Array | Mapping[str, Array], dtype: np.dtype, part: slice) -> Array:
    if not isinstance(columns, Mapping):
        return columns[part]
    parts = {key: column[part] for key, column in columns.items()}
    rows = np.empty(len(next(iter(parts.values()))), dtype=dtype)
    for key, values in parts.items():
        rows[key] = values
    return rows
