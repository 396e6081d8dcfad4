"""A teacher's action units where a dimension never varied in its data."""

import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.processor import NormalizerProcessorStep

from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy, gradient
from lerobot_agpd.guidance.units import ActionUnits

STATS = {"min": [0.0, 0.3], "max": [4.0, 0.3], "mean": [1.0, 0.3], "std": [2.0, 0.0]}


def units(mode: NormalizationMode, stats=STATS) -> ActionUnits:
    normaliser = NormalizerProcessorStep(
        features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        norm_map={FeatureType.ACTION: mode},
        stats={"action": {key: torch.tensor(value) for key, value in stats.items()}},
    )
    return ActionUnits(normaliser, 2)


@pytest.mark.parametrize(
    ("mode", "expected"), [(NormalizationMode.MIN_MAX, [0.5, -1.0]), (NormalizationMode.MEAN_STD, [1.0, 0.0])]
)
def test_a_constant_dimension_is_what_it_is_in_the_data(mode, expected):
    for error in (0.0, 1e-4, 0.5):
        value = units(mode).of(torch.tensor([[3.0, 0.3 + error]]))
        torch.testing.assert_close(value, torch.tensor([expected]), atol=1e-6, rtol=0)


def test_it_has_no_say_in_j():
    """The teacher says -1 there, up to its noise; the student is off by 1e-4, 20000 units of LeRobot's."""
    target = units(NormalizationMode.MIN_MAX).of(torch.tensor([[[3.0, 0.3001]]]))  # (B, n, A) = (1, 1, 2)
    j, grad = gradient(ActionDiscrepancy(target, 0), torch.tensor([[[0.0, -0.98]]]))
    assert j.item() == pytest.approx(0.5 * (0.5**2 + 0.02**2))
    assert grad.flatten().tolist() == pytest.approx([-0.5, 0.02])


def test_a_floored_dimension_is_no_constant():
    """Policies of this package divide by 1e-3 at least: such units are left as they are."""
    floored = STATS | {"std": [2.0, 1e-3]}
    value = units(NormalizationMode.MEAN_STD, floored).of(torch.tensor([3.0, 0.301]))
    torch.testing.assert_close(value, torch.tensor([1.0, 1.0]), atol=1e-3, rtol=0)
