"""Students and teachers as plain LeRobot checkpoints."""

import pytest
import torch
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

from lerobot_agpd.cli.export import ExportConfig, export
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)

UNET = {"denoiser": "unet", "down_dims": (16, 32), "diffusion_step_embed_dim": 16, "n_groups": 4}


@pytest.fixture
def saved(tmp_path, demonstrations):
    """Writes a policy with its processors."""

    def save(policy):
        folder = tmp_path / "checkpoint"
        policy.eval().save_pretrained(folder)
        for processor in make_pre_post_processors(policy.config, dataset_stats=demonstrations.meta.stats):
            processor.save_pretrained(folder)
        return folder

    return save


def observations(n_obs_steps: int | None) -> dict[str, torch.Tensor]:
    shape = (3,) if n_obs_steps is None else (3, n_obs_steps)
    return {
        "observation.state": torch.randn(*shape, 2),
        "observation.environment_state": torch.randn(*shape, 3),
    }


def test_an_act_student_becomes_an_act_policy(saved, agpd_config, tmp_path):
    policy = AGPDPolicy(agpd_config())
    export(ExportConfig(checkpoint=str(saved(policy)), output=tmp_path / "act"))
    plain = ACTPolicy.from_pretrained(tmp_path / "act", strict=True)
    batch = observations(None)
    difference = plain.predict_action_chunk(batch) - policy.predict_action_chunk(batch)
    assert difference.abs().max() <= 1e-6
    assert (tmp_path / "act" / "policy_preprocessor.json").is_file()


def test_a_unet_student_becomes_a_diffusion_policy(saved, agpd_diffusion_config, tmp_path):
    policy = AGPDDiffusionPolicy(agpd_diffusion_config(**UNET))
    export(ExportConfig(checkpoint=str(saved(policy)), output=tmp_path / "plain"))
    plain = DiffusionPolicy.from_pretrained(tmp_path / "plain", strict=True)
    assert type(plain.config).__name__ == "DiffusionConfig"
    batch, noise = observations(2), torch.randn(3, 8, 2)
    difference = plain.predict_action_chunk(batch, noise=noise) - policy.predict_action_chunk(
        batch, noise=noise
    )
    assert difference.abs().max() <= 1e-6


def test_networks_that_lerobot_does_not_have_are_refused(saved, input_features, output_features, tmp_path):
    features = {"input_features": input_features, "output_features": output_features}
    policy = DiffusionTransformerPolicy(
        DiffusionTransformerConfig(**features, push_to_hub=False, device="cpu")
    )
    with pytest.raises(ValueError, match="'diffusion_transformer' with denoiser 'mlp'.*denoiser=unet"):
        export(ExportConfig(checkpoint=str(saved(policy)), output=tmp_path / "plain"))
    assert not (tmp_path / "plain").exists()


def test_nothing_is_overwritten(tmp_path):
    with pytest.raises(FileExistsError, match="--output=.*already exists"):
        ExportConfig(checkpoint="anything", output=tmp_path)
