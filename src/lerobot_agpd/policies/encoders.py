"""Image encoders of the ACT student beside LeRobot's ResNet with frozen batch norm.

Each maps normalized images (B, 3, H, W) to `{"feature_map": (B, C, h, w)}`, as the backbone of LeRobot's ACT does, which
makes one token of every place of the map.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
import torchvision
from torch import Tensor, nn
from torchvision.models._utils import IntermediateLayerGetter

LAYERS = ((16, 7, 3), (32, 3, 2), (32, 3, 1), (32, 3, 1))
"""Of the small encoder's convolutions: channels, kernel size, stride."""

GRID = 16
"""Height and width of its last map, to which an image of 96 x 96 pixels comes by itself."""

FEATURES = 128
"""What it makes of an image."""

GROUP_SIZE = 8
"""Channels per group of its group norm."""

RESNET_GROUP_SIZE = 16
"""Channels per group where group norm takes the place of ResNet's batch norm (arXiv:1803.08494)."""


class SmallEncoder(nn.Module):
    """Four convolutions and a linear layer, for a CPU.

    The whole image becomes one token, so it costs ACT's transformer as much as a state. In training every image is
    shifted by up to `shift` pixels (DrQ, arXiv:2004.13649).

    Args:
        shift: largest shift, pixels; 0: none.
    """

    out_channels = FEATURES

    def __init__(self, shift: int):
        super().__init__()
        self.shift = shift
        layers: list[nn.Module] = []
        before = 3
        for channels, kernel, stride in LAYERS:
            layers += [
                nn.Conv2d(before, channels, kernel, stride, padding=kernel // 2, bias=False),
                nn.GroupNorm(channels // GROUP_SIZE, channels),
                nn.ReLU(inplace=True),
            ]
            before = channels
        self.convolutions = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(GRID))
        self.features = nn.Sequential(
            nn.Flatten(), nn.Linear(before * GRID**2, FEATURES), nn.LayerNorm(FEATURES), nn.Tanh()
        )

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        """Features (B, FEATURES, 1, 1) of normalized images (B, 3, H, W)."""
        if self.training and self.shift:
            images = random_shift(images, self.shift)
        return {"feature_map": self.features(self.convolutions(images))[..., None, None]}


def random_shift(images: Tensor, pixels: int) -> Tensor:
    """Shift every image (B, C, H, W) by up to `pixels` in x and y, its border repeated."""
    n, _, height, width = images.shape
    padded = F.pad(images, [pixels] * 4, mode="replicate")
    top, left = torch.randint(0, 2 * pixels + 1, (2, n, 1), device=images.device)
    rows = top + torch.arange(height, device=images.device)  # (B, H)
    columns = left + torch.arange(width, device=images.device)
    number = torch.arange(n, device=images.device)[:, None, None]
    shifted = padded.movedim(1, -1)[number, rows[:, :, None], columns[:, None, :]]  # (B, H, W, C)
    return shifted.movedim(-1, 1)


class GroupNormResNet(IntermediateLayerGetter):
    """The ResNet of LeRobot's ACT with group norm, which needs no pretrained statistics.

    Args:
        name: of torchvision's model, such as resnet18.
        replace_final_stride_with_dilation: as ACT's flag.
    """

    def __init__(self, name: str, replace_final_stride_with_dilation: bool = False):
        resnet = getattr(torchvision.models, name)(
            replace_stride_with_dilation=[False, False, replace_final_stride_with_dilation],
            norm_layer=lambda channels: nn.GroupNorm(channels // RESNET_GROUP_SIZE, channels),
        )
        super().__init__(resnet, return_layers={"layer4": "feature_map"})
        self.out_channels = resnet.fc.in_features
