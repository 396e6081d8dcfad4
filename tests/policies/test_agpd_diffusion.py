"""The diffusion student: the clean chunk its adversary sees, and the copy of itself that teaches it."""

import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler

from lerobot_agpd.config import AdversaryConfig
from lerobot_agpd.policies.agpd_diffusion.configuration_agpd_diffusion import AGPDDiffusionConfig
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy, clean_estimate

B, HORIZON, PRESENT = 5, 8, 1


@pytest.fixture
def policy(agpd_diffusion_config) -> AGPDDiffusionPolicy:
    return AGPDDiffusionPolicy(agpd_diffusion_config())


@pytest.fixture
def batch():
    return {
        "observation.state": torch.randn(B, 2, 2),
        "observation.environment_state": torch.randn(B, 2, 3),
        "action": torch.rand(B, HORIZON, 2) * 2 - 1,
        "action_is_pad": torch.zeros(B, HORIZON, dtype=torch.bool),
    }


# ---- the clean chunk ----


@pytest.mark.parametrize("prediction_type", ["epsilon", "sample"])
def test_a_perfect_prediction_gives_back_the_clean_chunk(prediction_type):
    scheduler = DDIMScheduler(100, prediction_type=prediction_type, beta_schedule="squaredcos_cap_v2")
    clean, noise = torch.rand(B, HORIZON, 2) * 2 - 1, torch.randn(B, HORIZON, 2)
    levels = torch.tensor([0, 10, 50, 80, 95])
    noisy = scheduler.add_noise(clean, noise, levels)
    predicted = noise if prediction_type == "epsilon" else clean
    torch.testing.assert_close(clean_estimate(scheduler, noisy, predicted, levels), clean, rtol=0, atol=1e-4)


def test_the_estimate_is_clipped_as_in_sampling():
    scheduler = DDIMScheduler(100, prediction_type="sample", clip_sample_range=0.5)
    estimate = clean_estimate(
        scheduler, torch.zeros(1, 2, 1), torch.tensor([[[3.0], [-0.2]]]), torch.tensor([9])
    )
    assert estimate.flatten().tolist() == pytest.approx([0.5, -0.2])


def test_estimate_agrees_with_the_schedulers_own(policy, batch):
    """diffusers computes the same x0_hat inside `step`."""
    scheduler = policy.diffusion.noise_scheduler
    scheduler.set_timesteps(100)
    level = 30
    noisy, predicted = torch.randn(B, HORIZON, 2), torch.randn(B, HORIZON, 2)
    theirs = scheduler.step(predicted, level, noisy).pred_original_sample
    ours = clean_estimate(scheduler, noisy, predicted, torch.full((B,), level))
    torch.testing.assert_close(ours, theirs)


def test_prior_chunk_starts_now_and_has_gradients(policy, batch):
    policy.train()
    prior = policy.prior_chunk(batch)
    assert prior.chunk.shape == (B, HORIZON - PRESENT, 2)
    assert prior.embedding.shape == (B, policy.embedding_dim) == (B, 2 * (2 + 3))
    prior.chunk.sum().backward()
    assert all(p.grad is not None for p in policy.diffusion.parameters())


# ---- what trains and what acts ----


def test_the_discriminator_sees_the_steps_from_now_on(policy):
    first = policy.discriminator.layers[0]
    assert first.in_features == (HORIZON - PRESENT) * 2 + policy.embedding_dim


def test_snapshot_acts_like_the_averaged_policy_and_stays_as_it_was(policy, batch):
    policy.train()
    optimizer = torch.optim.SGD(policy.diffusion.parameters(), lr=0.5)
    for _ in range(3):
        policy.forward(batch)[0].backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
    snapshot = policy.snapshot()
    assert policy.training and not snapshot.training
    assert not any(parameter.requires_grad for parameter in snapshot.parameters())
    observation = {key: value for key, value in batch.items() if key.startswith("observation")}
    noise = torch.randn(B, HORIZON, 2)
    policy.eval()
    expected = policy.predict_action_chunk(observation, noise=noise)
    torch.testing.assert_close(snapshot.predict_action_chunk(observation, noise=noise), expected)
    with torch.no_grad():
        for parameter in policy.diffusion.parameters():
            parameter.add_(1.0)
    torch.testing.assert_close(snapshot.predict_action_chunk(observation, noise=noise), expected)
    assert not torch.allclose(policy.predict_action_chunk(observation, noise=noise), expected)


def test_checkpoint_round_trip(policy, batch, tmp_path):
    policy.eval()
    policy.save_pretrained(tmp_path)
    loaded = AGPDDiffusionPolicy.from_pretrained(tmp_path)
    assert isinstance(loaded.config, AGPDDiffusionConfig)
    noise = torch.randn(B, HORIZON, 2)
    observation = {key: value for key, value in batch.items() if key.startswith("observation")}
    assert torch.equal(
        loaded.predict_action_chunk(observation, noise=noise),
        policy.predict_action_chunk(observation, noise=noise),
    )


def test_a_checkpoint_without_discriminator_can_be_distilled_on(agpd_diffusion_config, tmp_path):
    AGPDDiffusionPolicy(agpd_diffusion_config(adversary=AdversaryConfig(weight=0))).save_pretrained(tmp_path)
    loaded = AGPDDiffusionPolicy.from_pretrained(tmp_path, config=agpd_diffusion_config())
    assert loaded.discriminator is not None
