"""Images of foreign files, converted to uint8 by their range."""

from typing import Any

import numpy as np

ROWS_PER_BLOCK = 1024
"""Images read at once, so that a large file does not have to fit into memory as floats."""


def read_images(array: Any, name: str) -> np.ndarray:
    """Read images as uint8: floats in [0, 1] are multiplied by 255, other numbers lie in [0, 255].

    Args:
        array: (N, H, W, 3), in memory, of HDF5 or of zarr.
        name: of the array, for messages.

    Returns:
        (N, H, W, 3) uint8.

    Raises:
        ValueError: naming the shape or the range, if the array holds no such images.
    """
    if array.ndim != 4 or array.shape[-1] != 3:
        raise ValueError(f"{name} must be images (N, height, width, 3), found the shape {tuple(array.shape)}")
    if array.dtype == np.uint8:
        return np.asarray(array[:])
    blocks = [slice(start, start + ROWS_PER_BLOCK) for start in range(0, array.shape[0], ROWS_PER_BLOCK)]
    low = min((float(np.min(array[block])) for block in blocks), default=0.0)
    high = max((float(np.max(array[block])) for block in blocks), default=0.0)
    if not (low >= 0 and high <= 255):  # NaN is in no range
        raise ValueError(f"{name} must lie in [0, 1] or [0, 255], found values from {low:g} to {high:g}")
    scale = 255 if np.issubdtype(array.dtype, np.floating) and high <= 1 else 1
    images = np.empty(array.shape, dtype=np.uint8)
    for block in blocks:
        images[block] = np.rint(array[block] * scale)
    return images
