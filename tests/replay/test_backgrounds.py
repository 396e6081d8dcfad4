"""Training images before other backgrounds."""

import numpy as np
import pytest
import torch

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.replay.backgrounds import replace_backgrounds, require_masks
from lerobot_agpd.textures import Textures

NOISE = Textures("noise", "--flag")


@pytest.mark.parametrize("shape", [(5, 3, 8, 8), (5, 2, 3, 8, 8)])
def test_the_foreground_stays_and_every_frame_has_a_background_of_its_own(shape):
    images = torch.randint(256, shape, dtype=torch.uint8)
    masks = torch.zeros(shape, dtype=torch.uint8)
    masks[..., 4:, :] = 255
    shown = replace_backgrounds(images, masks, NOISE, np.random.default_rng(0))
    assert shown.dtype == torch.uint8 and torch.equal(shown[..., :4, :], images[..., :4, :])
    backgrounds = shown[..., 4:, :].flatten(1)
    assert len(backgrounds.unique(dim=0)) == 5
    if len(shape) == 5:  # a history is one scene
        assert torch.equal(shown[:, 0, :, 4:], shown[:, 1, :, 4:])


def test_what_backgrounds_need():
    held = {"observation.images.front", "observation.images.front_mask", "observation.images.side"}
    require_masks(["observation.images.front"], {"the data": held})
    with pytest.raises(
        FlagError, match=r"the data lack \['observation.images.side_mask'\].*--env.masks=true"
    ):
        require_masks(["observation.images.front", "observation.images.side"], {"the data": held})
    with pytest.raises(FlagError, match=r"sees the masks .*front_mask.*--policy.inputs"):
        require_masks(["observation.images.front_mask"], {"the data": held})
    with pytest.raises(FlagError, match="sees no camera"):
        require_masks([], {"the data": held})
