"""Features of camera images, for a discrepancy J on what cameras see (appendix A.4)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_agpd.flag_checks import FlagError

Normalize = Callable[[str, Tensor], Tensor]

MAP_SIZE = 4
"""Height and width of the feature map of a camera, pooled from the encoder's patches: 16 tokens."""

MAX_IMAGE_SIZE = 224
"""Images are resized to the multiple of the patch size at or above their own size, but at most to this, DINOv2's."""

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

STUDENT = "student"
"""`--policy.representation.encoder` of the student's own features."""


class VisualEncoder(ABC):
    """What makes features of images; not trained by the representation.

    Attributes:
        n_tokens: tokens N of all cameras.
        dim: features F of a token.
        is_frozen: whether an image always has the same features, so that they can be kept.
    """

    n_tokens: int
    dim: int
    is_frozen: bool

    @abstractmethod
    def load(self) -> None:
        """Load now what would be loaded at the first use."""

    @torch.no_grad()
    def encode(self, images: Mapping[str, Tensor], normalize: Normalize) -> Tensor:
        """Features (B, N * F) of the cameras' images (B, C, H, W) in [0, 1]: every token with mean 0 and variance 1.

        Args:
            images: by camera.
            normalize: the student's normalization of a camera's images.
        """
        tokens = self._tokens(images, normalize)  # (B, N, F)
        return F.layer_norm(tokens.float(), tokens.shape[-1:]).flatten(1)

    @abstractmethod
    def _tokens(self, images: Mapping[str, Tensor], normalize: Normalize) -> Tensor:
        """Tokens (B, N, F) of the cameras' images (B, C, H, W) in [0, 1]."""


class DinoEncoder(VisualEncoder):
    """Patch features of a frozen DINOv2 (arXiv:2304.07193), pooled to a map of MAP_SIZE x MAP_SIZE per camera.

    It is no nn.Module, so that it enters neither a student's weights nor DDP.

    Args:
        name: Hub repository or folder of a Dinov2Model of transformers, such as facebook/dinov2-small.
        cameras: names of the cameras, in order.
        device: where it runs.

    Raises:
        FlagError: if there is no such model, or transformers is not installed.
    """

    is_frozen = True

    def __init__(self, name: str, cameras: tuple[str, ...], device: str):
        try:
            from transformers import Dinov2Config  # takes seconds, and few runs need it
        except ModuleNotFoundError as error:
            raise FlagError(
                f"--policy.representation.encoder='{name}' needs the package {error.name!r}, which is not installed; run "
                f"pip install 'lerobot[transformers-dep]', or use the student's own features ('{STUDENT}')"
            ) from error

        self.name, self.cameras, self.device = name, cameras, device
        config: Any = self._read(Dinov2Config)
        self.patch_size = int(config.patch_size)
        self.n_tokens, self.dim = MAP_SIZE**2 * len(cameras), int(config.hidden_size)

    @cached_property
    def model(self) -> Any:
        """The network, loaded when it is first used: to act, a student does not need it."""
        from transformers import Dinov2Model

        return self._read(Dinov2Model).to(self.device).eval().requires_grad_(False)

    def load(self) -> None:
        """Load the network."""
        _ = self.model

    def _read(self, kind: Any) -> Any:
        try:
            return kind.from_pretrained(self.name)
        except (OSError, ValueError) as error:
            is_folder = Path(self.name).is_dir()
            where = (
                "has no such model"
                if is_folder
                else "is neither a folder nor a Hub repository that can be reached"
            )
            raise FlagError(
                f"--policy.representation.encoder='{self.name}' {where} ({str(error).splitlines()[0]}); name a Dinov2Model "
                f"of transformers, such as facebook/dinov2-small, or '{STUDENT}' for the student's own features"
            ) from error

    def _tokens(self, images: Mapping[str, Tensor], normalize: Normalize) -> Tensor:
        return torch.cat([self._camera_tokens(images[key].to(self.device)) for key in self.cameras], dim=1)

    def _camera_tokens(self, images: Tensor) -> Tensor:
        patch = self.patch_size
        height, width = (
            min(math.ceil(size / patch), max(MAX_IMAGE_SIZE // patch, 1)) * patch
            for size in images.shape[-2:]
        )
        resized = F.interpolate(images, (height, width), mode="bilinear", antialias=True, align_corners=False)
        mean, std = (
            torch.tensor(values).view(3, 1, 1).to(images) for values in (IMAGENET_MEAN, IMAGENET_STD)
        )
        tokens = self.model(
            (resized - mean) / std
        ).last_hidden_state  # (B, 1 + h * w, F), the class token first
        return pooled(tokens[:, 1:].transpose(1, 2).unflatten(2, (height // patch, width // patch)))


def pooled(maps: Tensor) -> Tensor:
    """Tokens (B, N, F) of feature maps (B, F, h, w), which are averaged to at most MAP_SIZE x MAP_SIZE."""
    height, width = (min(side, MAP_SIZE) for side in maps.shape[-2:])
    return F.adaptive_avg_pool2d(maps, (height, width)).flatten(2).transpose(1, 2)
