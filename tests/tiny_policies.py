"""Tiny, randomly initialized teachers of LeRobot's own classes, and the raw observations they look at."""

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import get_policy_class, make_policy_config, make_pre_post_processors

from lerobot_agpd.guidance.adapters import as_teacher

STATE, CAMERA = "observation.state", "observation.images.top"
STATE_ONLY = {STATE: PolicyFeature(FeatureType.STATE, (3,))}
WITH_CAMERA = {**STATE_ONLY, CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 64, 64))}
ACTIONS = {"action": PolicyFeature(FeatureType.ACTION, (2,))}

DIFFUSION = {"horizon": 8, "n_action_steps": 4, "down_dims": (8,), "n_groups": 2, "num_train_timesteps": 20}
ACT = {
    "chunk_size": 6,
    "n_action_steps": 4,
    "dim_model": 16,
    "n_heads": 2,
    "dim_feedforward": 16,
    "n_encoder_layers": 1,
    "n_vae_encoder_layers": 1,
    "latent_dim": 4,
    "pretrained_backbone_weights": None,
}


def statistics(features) -> dict:
    """Means, spreads and ranges that no feature has by accident."""
    numbers = {"mean": 0.5, "std": 2.0, "min": -1.0, "max": 3.0, "q01": -1.0, "q99": 3.0}
    shapes = {key: (3, 1, 1) if len(ft.shape) == 3 else ft.shape for key, ft in features.items()}
    return {key: {name: torch.full(s, x) for name, x in numbers.items()} for key, s in shapes.items()}


def make_config(policy_type, inputs, **options):
    config = make_policy_config(policy_type, device="cpu", push_to_hub=False, **options)
    config.input_features, config.output_features = dict(inputs), dict(ACTIONS)
    return config


def make_policy(policy_type, inputs, **options):
    """A policy with its processors."""
    config = make_config(policy_type, inputs, **options)
    torch.manual_seed(0)
    policy = get_policy_class(policy_type)(config)
    return policy, *make_pre_post_processors(config, dataset_stats=statistics({**inputs, **ACTIONS}))


def make_teacher(policy_type, inputs, **options):
    return as_teacher(*make_policy(policy_type, inputs, **options))


def history(inputs, batch=3, length=2, seed=0, task=None) -> dict:
    """Raw observations (B, T, ...)."""
    noise = torch.Generator().manual_seed(seed)
    observations = {key: torch.rand(batch, length, *ft.shape, generator=noise) for key, ft in inputs.items()}
    return observations if task is None else {**observations, "task": [task] * batch}


def generator(seed=0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
