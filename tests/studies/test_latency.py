"""What the latency of a chunk is measured on."""

import torch

from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy
from lerobot_agpd.studies.latency import chunk_latency, random_observations
from lerobot_agpd.weights import acting_parameters


def test_only_the_acting_network_is_counted(agpd_config, agpd_diffusion_config):
    act, diffusion = AGPDPolicy(agpd_config()), AGPDDiffusionPolicy(agpd_diffusion_config())
    assert act.discriminator is not None and diffusion.discriminator is not None
    for policy, network in ((act, act.model), (diffusion, diffusion.diffusion)):
        assert acting_parameters(policy) == sum(parameter.numel() for parameter in network.parameters())
        assert acting_parameters(policy) < sum(parameter.numel() for parameter in policy.parameters())


def test_observations_have_the_history_a_policy_wants(agpd_config, agpd_diffusion_config):
    act, diffusion = AGPDPolicy(agpd_config()), AGPDDiffusionPolicy(agpd_diffusion_config(n_obs_steps=1))
    assert random_observations(act, 4)["observation.state"].shape == (4, 2)
    assert random_observations(diffusion, 4)["observation.state"].shape == (4, 1, 2)


def test_latency_of_a_batch(agpd_diffusion_config):
    policy = AGPDDiffusionPolicy(agpd_diffusion_config()).eval()
    latency = chunk_latency(policy, batch_size=3, repeats=5)
    assert 0 < latency.median_ms <= latency.p95_ms and latency.threads == torch.get_num_threads()
