"""Backgrounds for images: drawn at random, or cut from a folder of pictures."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lerobot_agpd.flag_checks import require

Pixels = NDArray[np.uint8]

KINDS = ("noise", "stripes")
"""Textures that are drawn: smooth colored noise, and stripes of two colors in any direction."""

MASK_SUFFIX = "_mask"
"""What the name of a camera's mask ends with; masks are white where the background is."""

PICTURE_SIZE = 640
"""Longest side of a picture that is held in memory, pixels: photographs are made smaller once."""

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")


def mask_of(camera: str) -> str:
    """Name of a camera's mask."""
    return camera + MASK_SUFFIX


class Textures:
    """A source of backgrounds.

    Args:
        source: one of KINDS, or a folder of pictures.
        flag: that names it, for messages.

    Raises:
        FlagError: if it is neither.
    """

    def __init__(self, source: str, flag: str):
        self.source = source
        self._paths: list[Path] = []
        if source not in KINDS:
            folder = Path(source)
            self._paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
            require(
                bool(self._paths),
                f"{flag}={source} must be one of {', '.join(KINDS)}, or a folder with pictures ({', '.join(SUFFIXES)})",
            )

    def draw(self, rng: np.random.Generator, height: int, width: int) -> Pixels:
        """A background (height, width, 3)."""
        if self.source == "noise":
            return _noise(rng, height, width)
        if self.source == "stripes":
            return _stripes(rng, height, width)
        return _cut(_picture(self._paths[rng.integers(len(self._paths))]), rng, height, width)


def _noise(rng: np.random.Generator, height: int, width: int) -> Pixels:
    """A random grid of 2 to 12 colors a side, enlarged smoothly."""
    grid = rng.integers(256, size=(*rng.integers(2, 13, size=2), 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(grid).resize((width, height), Image.Resampling.BICUBIC))


def _stripes(rng: np.random.Generator, height: int, width: int) -> Pixels:
    """Stripes of two colors, 3 to 20 pixels wide."""
    angle, stripe = rng.uniform(0, np.pi), rng.uniform(3, 20)
    row, column = np.mgrid[:height, :width]
    first = ((np.cos(angle) * row + np.sin(angle) * column + rng.uniform(0, 40)) // stripe) % 2 == 0
    colors = rng.integers(256, size=(2, 3), dtype=np.uint8)
    return np.where(first[..., None], colors[0], colors[1])


def _cut(picture: Image.Image, rng: np.random.Generator, height: int, width: int) -> Pixels:
    """A random part of a picture, at least half as large as it, in the shape of the image."""
    scale = rng.uniform(0.5, 1) * min(picture.width / width, picture.height / height)
    size = (scale * width, scale * height)
    left, top = (rng.uniform(0, max(full - part, 0)) for full, part in zip(picture.size, size, strict=True))
    box = (left, top, left + size[0], top + size[1])
    return np.asarray(picture.resize((width, height), Image.Resampling.BILINEAR, box=box))


@lru_cache(maxsize=256)
def _picture(path: Path) -> Image.Image:
    with Image.open(path) as file:
        picture = file.convert("RGB")
    picture.thumbnail((PICTURE_SIZE, PICTURE_SIZE))
    return picture
