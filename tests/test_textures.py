"""Backgrounds drawn at random or cut from pictures."""

import numpy as np
import pytest
from PIL import Image

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.textures import KINDS, Textures


@pytest.mark.parametrize("kind", KINDS)
def test_drawn_backgrounds_differ_and_follow_from_the_generator(kind):
    textures = Textures(kind, "--flag")
    first, second = (textures.draw(np.random.default_rng(seed), 12, 20) for seed in (0, 1))
    again = textures.draw(np.random.default_rng(0), 12, 20)
    assert first.shape == (12, 20, 3) and first.dtype == np.uint8
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, second)


@pytest.mark.parametrize("size", [(40, 30), (8, 100), (5, 5)])
def test_a_picture_of_any_shape_is_cut(tmp_path, size):
    Image.new("RGB", size, (10, 200, 30)).save(tmp_path / "a.png")
    drawn = Textures(str(tmp_path), "--flag").draw(np.random.default_rng(0), 12, 20)
    assert drawn.shape == (12, 20, 3) and (drawn == [10, 200, 30]).all()


def test_a_source_that_is_none(tmp_path):
    with pytest.raises(FlagError, match=r"--flag=.*noise, stripes, or a folder with pictures"):
        Textures(str(tmp_path), "--flag")
