"""A teacher's normalized action space where a dimension never varied in its data."""

import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.processor import NormalizerProcessorStep

from lerobot_agpd.guidance.action_normalizer import ActionNormalizer
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy

STATS = {"min": [0.0, 0.3], "max": [4.0, 0.3], "mean": [1.0, 0.3], "std": [2.0, 0.0]}


def normalizer(mode: NormalizationMode, stats=STATS) -> ActionNormalizer:
    step = NormalizerProcessorStep(
        features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        norm_map={FeatureType.ACTION: mode},
        stats={"action": {key: torch.tensor(value) for key, value in stats.items()}},
    )
    return ActionNormalizer(step, 2)


@pytest.mark.parametrize(
    ("mode", "expected"), [(NormalizationMode.MIN_MAX, [0.5, -1.0]), (NormalizationMode.MEAN_STD, [1.0, 0.0])]
)
@pytest.mark.parametrize("error", [0.0, 1e-4, 0.5])
def test_a_constant_dimension_gets_the_value_it_has_in_the_data(mode, expected, error):
    value = normalizer(mode).normalize(torch.tensor([[3.0, 0.3 + error]]))
    torch.testing.assert_close(value, torch.tensor([expected]), atol=1e-6, rtol=0)


def test_a_constant_dimension_does_not_dominate_j():
    """The teacher predicts -1 there, up to its noise; the student is off by 1e-4, 20000 of LeRobot's units."""
    target = normalizer(NormalizationMode.MIN_MAX).normalize(torch.tensor([[[3.0, 0.3001]]]))  # (B, n, A)
    action_j, chunk = ActionDiscrepancy(target, 0), torch.tensor([[[0.0, -0.98]]])
    assert action_j(chunk).item() == pytest.approx(0.5 * (0.5**2 + 0.02**2))
    assert action_j.gradient(chunk).flatten().tolist() == pytest.approx([-0.5, 0.02])


def test_a_dimension_with_a_floored_spread_is_not_constant():
    """Policies of this package divide by 1e-3 at least: such dimensions keep their values."""
    floored = STATS | {"std": [2.0, 1e-3]}
    value = normalizer(NormalizationMode.MEAN_STD, floored).normalize(torch.tensor([3.0, 0.301]))
    torch.testing.assert_close(value, torch.tensor([1.0, 1.0]), atol=1e-3, rtol=0)
