"""A tiny random teacher and its student on Push-T, as checkpoints."""

from pathlib import Path

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd.processor_agpd import make_agpd_pre_post_processors
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)
from lerobot_agpd.policies.diffusion_transformer.processor_diffusion_transformer import (
    make_diffusion_transformer_pre_post_processors,
)

INPUTS = {
    OBS_STATE: PolicyFeature(type=FeatureType.STATE, shape=(2,)),
    OBS_ENV_STATE: PolicyFeature(type=FeatureType.ENV, shape=(16,)),
}
OUTPUTS = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(2,))}
STATS = {
    key: {
        "min": torch.zeros(dim),
        "max": torch.full((dim,), 512.0),
        "mean": torch.full((dim,), 256.0),
        "std": torch.full((dim,), 100.0),
    }
    for key, dim in ((OBS_STATE, 2), (OBS_ENV_STATE, 16), (ACTION, 2))
}
N_STEPS = 4


def save(policy, processors, path: Path) -> Path:
    policy.save_pretrained(path)
    for processor in processors:
        processor.save_pretrained(path)
    return path


@pytest.fixture(scope="session")
def teacher(tmp_path_factory) -> Path:
    config = DiffusionTransformerConfig(
        prediction_type="epsilon",  # a random predictor of clean chunks would not feel the pull
        input_features=INPUTS,
        output_features=OUTPUTS,
        device="cpu",
        push_to_hub=False,
        horizon=8,
        n_action_steps=N_STEPS,
        drop_n_last_frames=3,
        num_train_timesteps=20,
        num_inference_steps=5,
    )
    config.mlp.width, config.mlp.n_blocks = 32, 1
    torch.manual_seed(0)
    processors = make_diffusion_transformer_pre_post_processors(config, STATS)
    return save(DiffusionTransformerPolicy(config), processors, tmp_path_factory.mktemp("teacher"))


def make_student(path: Path, teacher: Path, representation: str = "action") -> Path:
    config = AGPDConfig(
        input_features=INPUTS,
        output_features=OUTPUTS,
        device="cpu",
        push_to_hub=False,
        chunk_size=8,
        n_action_steps=N_STEPS,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        latent_dim=4,
    )
    config.teacher.path = str(teacher)
    config.guidance.scale = 2.0
    config.representation.type = representation
    torch.manual_seed(1)
    return save(AGPDPolicy(config), make_agpd_pre_post_processors(config, STATS), path)


@pytest.fixture(scope="session")
def student_of():
    """Writes a student with a given representation."""
    return make_student


@pytest.fixture
def student(tmp_path, teacher) -> Path:
    return make_student(tmp_path / "run/checkpoints/000010/pretrained_model", teacher)
