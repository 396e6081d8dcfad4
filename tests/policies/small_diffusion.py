"""A small diffusion policy in training: what its tests share."""

import torch
from lerobot.configs import PreTrainedConfig

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    MLPDenoiserConfig,
    TransformerDenoiserConfig,
)
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)
from lerobot_agpd.run import RunInfo

B = 4
DENOISERS = {
    "mlp": {"denoiser": "mlp"},
    "transformer": {"denoiser": "transformer"},
    "unet": {"denoiser": "unet", "down_dims": (16,)},
}


SMALL = {
    "horizon": 8,
    "n_action_steps": 4,
    "num_train_timesteps": 10,
    "mlp": MLPDenoiserConfig(width=16, n_blocks=1),
    "transformer": TransformerDenoiserConfig(width=16, n_layers=1, n_heads=2, attention_dropout=0.0),
    "device": "cpu",
    "push_to_hub": False,
}


def weights(policy):
    return {key: value.detach().clone() for key, value in policy.state_dict().items()}


def same(left, right) -> bool:
    return left.keys() == right.keys() and all(torch.equal(left[key], right[key]) for key in left)


def fit(policy, batch, n_steps):
    """A few of LeRobot's training steps; the weights after each of them."""
    policy.train()
    optimizer = torch.optim.SGD(policy.parameters(), lr=0.1)
    after = []
    for _ in range(n_steps):
        optimizer.zero_grad()
        policy.forward(batch)[0].backward()
        optimizer.step()
        policy.update()
        after.append(weights(policy))
    return after


def resumed(folder, resume=True) -> DiffusionTransformerPolicy:
    """The policy of a run that continues, or only starts from, a checkpoint."""
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    return DiffusionTransformerPolicy.from_pretrained(folder, config=config, run=RunInfo(resume=resume))
