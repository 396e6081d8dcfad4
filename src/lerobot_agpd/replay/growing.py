"""A tensor that grows in place."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

GROWTH = 1.5
"""Factor by which capacity grows: n appended rows cost O(n) copies, and at most a third of the rows is spare."""


class GrowingTensor:
    """A tensor whose first dimension grows.

    Args:
        row_shape: shape of one row.
        dtype: of the values.
        device: of the values.
    """

    def __init__(self, row_shape: Sequence[int], dtype: torch.dtype, device: torch.device | str = "cpu"):
        self._storage = torch.empty((0, *row_shape), dtype=dtype, device=device)
        self._size = 0

    def __len__(self) -> int:
        """Number of rows."""
        return self._size

    @property
    def values(self) -> Tensor:
        """The rows (N, *row_shape), a view that is valid until the next growth."""
        return self._storage[: self._size]

    @property
    def nbytes(self) -> int:
        """Bytes in memory, spare capacity included."""
        return self._storage.nbytes

    def append(self, rows: Tensor) -> None:
        """Copy rows (n, *row_shape) to the end."""
        self.grow(len(rows)).copy_(rows)

    def grow(self, n_rows: int) -> Tensor:
        """Add uninitialized rows and return a view of them."""
        start, self._size = self._size, self._size + n_rows
        if self._size > len(self._storage):
            capacity = max(self._size, int(GROWTH * len(self._storage)))
            grown = self._storage.new_empty((capacity, *self._storage.shape[1:]))
            grown[:start] = self._storage[:start]
            self._storage = grown
        return self._storage[start : self._size]
