"""A small teacher on disk and the first steps of a training loop."""

from pathlib import Path

import pytest
import torch
from lerobot.policies import make_pre_post_processors

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
    MLPDenoiserConfig,
)
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)


@pytest.fixture
def save_teacher(tmp_path, demonstrations, input_features, output_features):
    """Writes a random teacher with its processors; features can be exchanged."""

    def save(inputs=None, outputs=None) -> Path:
        config = DiffusionTransformerConfig(
            input_features=inputs or dict(input_features),
            output_features=outputs or dict(output_features),
            mlp=MLPDenoiserConfig(width=8, n_blocks=1),
            num_inference_steps=2,
            noise_scheduler_type="DDIM",
            device="cpu",
            push_to_hub=False,
        )
        folder = tmp_path / "teacher"
        DiffusionTransformerPolicy(config).save_pretrained(folder)
        for processor in make_pre_post_processors(config, dataset_stats=demonstrations.meta.stats):
            processor.save_pretrained(folder)
        return folder

    return save


@pytest.fixture
def loop_batch(demonstrations):
    """What `lerobot-train` hands to a policy's forward for given frames of the demonstrations."""

    def batch(config, frames):
        preprocessor, _ = make_pre_post_processors(config, dataset_stats=demonstrations.meta.stats)
        items = [demonstrations[frame] for frame in frames]
        return preprocessor(torch.utils.data.default_collate(items))

    return batch
