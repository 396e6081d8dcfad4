"""A small teacher on disk, and the first steps of a training loop."""

from pathlib import Path

import pytest
import torch
from lerobot.policies import make_pre_post_processors

from lerobot_agpd.config import AdversaryConfig, CollectConfig, TeacherConfig
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
    MLPDenoiserConfig,
)
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)
from lerobot_agpd.run import RunInfo


@pytest.fixture
def save_policy(tmp_path, demonstrations):
    """Writes a policy with its processors, and names its folder as a teacher."""

    def save(policy) -> TeacherConfig:
        folder: Path = tmp_path / policy.name
        policy.save_pretrained(folder)
        for processor in make_pre_post_processors(policy.config, dataset_stats=demonstrations.meta.stats):
            processor.save_pretrained(folder)
        return TeacherConfig(path=str(folder))

    return save


@pytest.fixture
def save_teacher(save_policy, input_features, output_features):
    """Writes a random diffusion teacher (chunks of 16 steps, one of them past); features can be exchanged."""

    def save(inputs=None, outputs=None) -> TeacherConfig:
        config = DiffusionTransformerConfig(
            input_features=inputs or dict(input_features),
            output_features=outputs or dict(output_features),
            mlp=MLPDenoiserConfig(width=8, n_blocks=1),
            num_inference_steps=2,
            noise_scheduler_type="DDIM",
            device="cpu",
            push_to_hub=False,
        )
        return save_policy(DiffusionTransformerPolicy(config))

    return save


@pytest.fixture
def build(demonstrations, tmp_path):
    """Builds a policy as a training run does."""

    def build(config, policy_class=AGPDPolicy, dataset=demonstrations, **facts):
        run = RunInfo(**{"output_dir": tmp_path / "run", **facts})
        return policy_class(config, dataset.meta.stats, dataset.meta, run=run).train()

    return build


@pytest.fixture
def loop_batch(demonstrations):
    """What `lerobot-train` hands to a policy's forward for given frames of a dataset."""

    def batch(config, frames, dataset=demonstrations):
        preprocessor, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
        return preprocessor(torch.utils.data.default_collate([dataset[frame] for frame in frames]))

    return batch


NO_ROUNDS = CollectConfig(every=0)
NO_ADVERSARY = AdversaryConfig(weight=0)
