"""Fixtures shared by the fast tests: a small dataset and small configurations."""

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from small_dataset import make_dataset


@pytest.fixture(scope="session")
def demonstrations(tmp_path_factory) -> LeRobotDataset:
    """Three episodes of 5, 1 and 7 random frames."""
    return make_dataset(tmp_path_factory.mktemp("data") / "small")


@pytest.fixture(scope="session")
def input_features() -> dict[str, PolicyFeature]:
    return {
        "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (3,)),
    }


@pytest.fixture(scope="session")
def output_features() -> dict[str, PolicyFeature]:
    return {"action": PolicyFeature(FeatureType.ACTION, (2,))}


@pytest.fixture
def agpd_config(input_features, output_features):
    """Builds configurations of a tiny student."""
    from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig

    def build(**options):
        sizes = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 64, "chunk_size": 8, "n_action_steps": 4}
        layers = {"n_encoder_layers": 1, "n_decoder_layers": 1, "n_vae_encoder_layers": 1, "latent_dim": 8}
        features = {"input_features": dict(input_features), "output_features": dict(output_features)}
        return AGPDConfig(**{**sizes, **layers, **features, "device": "cpu", "push_to_hub": False, **options})

    return build


@pytest.fixture
def agpd_diffusion_config(input_features, output_features):
    """Builds configurations of a tiny diffusion student."""
    from lerobot_agpd.policies.agpd_diffusion.configuration_agpd_diffusion import AGPDDiffusionConfig
    from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
        MLPDenoiserConfig,
    )

    def build(**options):
        sizes = {"horizon": 8, "n_action_steps": 4, "drop_n_last_frames": 3, "num_inference_steps": 10}
        network = {"denoiser": "mlp", "mlp": MLPDenoiserConfig(width=16, n_blocks=1)}
        features = {"input_features": dict(input_features), "output_features": dict(output_features)}
        common = {"noise_scheduler_type": "DDIM", "device": "cpu", "push_to_hub": False}
        return AGPDDiffusionConfig(**{**sizes, **network, **features, **common, **options})

    return build


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def rendering() -> None:
    """Skip tests that need images where MuJoCo cannot open a graphics context."""
    mujoco = pytest.importorskip("mujoco")
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # whatever the graphics library raises
        pytest.skip(f"no graphics context (is MUJOCO_GL set?): {error}")
