"""Unpickling of numpy arrays in builtin containers, and of nothing else.

A pickle names the functions that rebuild it, so loading one that a stranger wrote runs the stranger's code. Here the three
names that an array needs are known beforehand and every other one is refused; nothing is imported.
"""

import pickle
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

_ARRAY_PARTS = {
    "_reconstruct": np.empty(0).__reduce__()[0],
    "ndarray": np.ndarray,
    "dtype": np.dtype,
}
_MODULES = {
    "_reconstruct": ("numpy.core.multiarray", "numpy._core.multiarray"),
    "ndarray": ("numpy",),
    "dtype": ("numpy",),
}


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str, /) -> Any:
        if module_name in _MODULES.get(global_name, ()):
            return _ARRAY_PARTS[global_name]
        raise pickle.UnpicklingError(
            f"it names {module_name}.{global_name}; only arrays, numbers, text and containers are read"
        )

    def persistent_load(self, pid: Any) -> NoReturn:
        raise pickle.UnpicklingError(f"it refers to an object outside of the file, {pid!r}")


def load_arrays(path: Path) -> Any:
    """Read a pickle (protocol 3 or 4) of lists, dicts, numbers, text and numpy arrays.

    Raises:
        ValueError: naming the file and what it asks for, if it holds anything else or is damaged.
    """
    try:
        with path.open("rb") as file:
            return _ArrayUnpickler(file, encoding="latin1").load()
    except Exception as error:  # a damaged pickle may raise anything
        raise ValueError(f"{path} is no pickle of numpy arrays: {error}") from error
