import pytest

from lerobot_agpd.guidance.config import GuidanceConfig
from lerobot_agpd.guidance.controller import next_scale

CONFIG = GuidanceConfig(scale=1.0, growth=2.0, tolerance=0.1, min_scale=0.25, max_scale=4.0)


@pytest.mark.parametrize(
    ("scale", "guided", "unguided", "expected"),
    [
        (1.0, 0.8, 0.8, 2.0),
        (1.0, 1.0, 0.2, 2.0),  # better than the teacher alone
        (1.0, 0.41, 0.5, 2.0),  # within the tolerance
        (1.0, 0.39, 0.5, 0.5),  # beyond it
        (1.0, 0.0, 0.0, 2.0),  # a teacher that never succeeds cannot be hurt
        (3.0, 0.8, 0.8, 4.0),  # upper limit
        (0.3, 0.0, 0.8, 0.25),  # lower limit
        (9.0, 0.8, 0.8, 9.0),  # a first scale beyond the limit never grows
        (9.0, 0.0, 0.8, 4.5),  # and comes back
        (0.1, 0.0, 0.8, 0.1),  # one below never shrinks to something larger
        (1.0, None, 0.8, 1.0),  # nothing was guided
        (1.0, 0.8, None, 1.0),  # nothing to compare with
    ],
)
def test_next_scale(scale, guided, unguided, expected):
    assert next_scale(scale, guided, unguided, CONFIG) == expected


def test_fixed_scale_stays():
    assert next_scale(1.0, 1.0, 0.0, GuidanceConfig(scale=1.0, adaptive=False)) == 1.0


def test_guidance_that_is_off_stays_off():
    assert next_scale(0.0, 1.0, 0.0, GuidanceConfig(scale=0.0)) == 0.0


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        ({"scale": -1}, "guidance.scale"),
        ({"at": "x1"}, "guidance.at"),
        ({"trust_region": 0}, "guidance.trust_region"),
        ({"growth": 1}, "guidance.growth"),
        ({"tolerance": 1}, "guidance.tolerance"),
        ({"min_scale": 2, "max_scale": 1}, "guidance.min_scale"),
    ],
)
def test_wrong_flags_are_named(options, flag):
    with pytest.raises(ValueError, match=flag):
        GuidanceConfig(**options)
