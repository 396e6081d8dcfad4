"""Small diffusion policies."""

import pytest
import torch
from small_diffusion import SMALL, B

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)
from lerobot_agpd.run import RunInfo


@pytest.fixture
def make_policy(input_features, output_features):
    def build(run=None, **options) -> DiffusionTransformerPolicy:
        features = {"input_features": dict(input_features), "output_features": dict(output_features)}
        config = DiffusionTransformerConfig(**{**SMALL, **features, **options})
        return DiffusionTransformerPolicy(config, run=run or RunInfo())

    return build


@pytest.fixture
def batch():
    return {
        "observation.state": torch.randn(B, 2, 2),
        "observation.environment_state": torch.randn(B, 2, 3),
        "action": torch.randn(B, 8, 2),
        "action_is_pad": torch.zeros(B, 8, dtype=torch.bool),
    }
