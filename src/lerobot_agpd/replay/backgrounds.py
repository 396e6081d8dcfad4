"""Training images with another background at every draw, so that a student learns to look past it (section 5.2)."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.flag_checks import require
from lerobot_agpd.textures import MASK_SUFFIX, Textures, mask_of


def replace_backgrounds(
    images: Tensor, masks: Tensor, textures: Textures, rng: np.random.Generator
) -> Tensor:
    """Images with backgrounds drawn for every one; those of a history share theirs.

    Args:
        images: (B, ..., 3, H, W) uint8.
        masks: (B, ..., 3, H, W) uint8, 255 on the background.
        textures: the backgrounds.
        rng: draws them.

    Returns:
        (B, ..., 3, H, W) uint8.
    """
    height, width = images.shape[-2:]
    drawn = np.stack([textures.draw(rng, height, width) for _ in range(len(images))])  # (B, H, W, 3)
    backgrounds = torch.from_numpy(drawn).permute(0, 3, 1, 2)
    backgrounds = backgrounds.reshape(len(images), *[1] * (images.ndim - 4), 3, height, width)
    return torch.where(masks > 127, backgrounds, images)


def require_masks(cameras: Sequence[str], sources: dict[str, Collection[str]]) -> None:
    """Refuse cameras without masks, and masks among the cameras that a student sees.

    Args:
        cameras: those that the student sees.
        sources: the features that demonstrations and environment hold, by what to call these.

    Raises:
        FlagError: naming the masks that are missing.
    """
    flag = "--policy.replay.backgrounds"
    seen = [camera for camera in cameras if camera.endswith(MASK_SUFFIX)]
    require(
        not seen, f"{flag}: the student sees the masks {seen} too; choose what it sees with --policy.inputs"
    )
    require(bool(cameras), f"{flag}: the student sees no camera")
    for source, features in sources.items():
        missing = [mask_of(camera) for camera in cameras if mask_of(camera) not in features]
        require(
            not missing,
            f"{flag} needs a mask for every camera; {source} lack {missing}, of {sorted(features)}; record them with "
            "--env.masks=true",
        )
