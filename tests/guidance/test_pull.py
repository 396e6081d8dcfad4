"""Pull: the recursion against the sampler itself, its inverse, and what is refused."""

import math

import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from hypothesis import given, settings, strategies as st

from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy
from lerobot_agpd.guidance.flow import guided_velocity
from lerobot_agpd.guidance.guide import Guide, GuidedScheduler
from lerobot_agpd.guidance.pull import (
    DISTANCE,
    SPREAD,
    acts,
    chain_moments,
    diffusion_sampler,
    flow_sampler,
    largest_pull,
    pull_of_scale,
    scale_of_pull,
)

SCHEDULERS = {"DDPM": DDPMScheduler, "DDIM": DDIMScheduler}


def scheduler(kind):
    return SCHEDULERS[kind](num_train_timesteps=100, beta_schedule="squaredcos_cap_v2", clip_sample=False)


def sampler(kind, n_steps):
    return flow_sampler(n_steps) if kind == "flow" else diffusion_sampler(scheduler(kind), n_steps)


def sample(kind, n_steps, scale, at, spread, distance, n=400, width=64):
    """The guided sampler itself around an exact denoiser: chunks (n, width, 1)."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn((n, width, 1), generator=generator, dtype=torch.float64)
    guide = Guide(ActionDiscrepancy(torch.full_like(x, distance), 0), torch.full((n,), scale), at=at)
    if kind == "flow":
        for step in range(n_steps):
            tau = step / n_steps
            x0_hat = tau * spread**2 / (tau**2 * spread**2 + (1 - tau) ** 2) * x
            x = x + guided_velocity(guide, x, (x0_hat - x) / (1 - tau), tau, 1) / n_steps
        return x
    plain = scheduler(kind)
    proxy = GuidedScheduler(plain, guide)
    proxy.set_timesteps(n_steps)
    for t in proxy.timesteps:
        abar = float(plain.alphas_cumprod[t])
        x0_hat = math.sqrt(abar) * spread**2 / (abar * spread**2 + 1 - abar) * x
        noise = (x - math.sqrt(abar) * x0_hat) / math.sqrt(1 - abar)
        x = proxy.step(noise, t, x, generator=generator).prev_sample
    return x


@pytest.mark.parametrize("at", ["x0", "mu"])
@pytest.mark.parametrize(("kind", "n_steps"), [("DDPM", 10), ("DDPM", 50), ("DDIM", 10), ("DDIM", 5)])
@pytest.mark.parametrize(("scale", "distance"), [(0.5, 0.3), (4.0, 0.3), (4.0, 3.0)])
def test_recursion_is_the_sampler_with_both_caps(kind, n_steps, at, scale, distance):
    """The last case lies far outside of the trust region, which 64 entries make as good as deterministic."""
    x = sample(kind, n_steps, scale, at, 0.4, distance)
    mean, variance = chain_moments(sampler(kind, n_steps), scale, at, 0.4, distance)
    assert x.mean().item() == pytest.approx(mean, abs=4 * math.sqrt(variance / x.numel()) + 0.004 * distance)
    assert x.var().item() == pytest.approx(variance, rel=0.06, abs=1e-3 * distance)


@pytest.mark.parametrize("n_steps", [1, 5, 20])
@pytest.mark.parametrize(("scale", "distance"), [(0.5, 0.3), (4.0, 3.0)])
def test_recursion_is_the_guided_flow(n_steps, scale, distance):
    x = sample("flow", n_steps, scale, "x0", 0.4, distance)
    mean, variance = chain_moments(sampler("flow", n_steps), scale, "x0", 0.4, distance)
    assert x.mean().item() == pytest.approx(mean, abs=4 * math.sqrt(variance / x.numel()) + 0.004 * distance)
    assert x.var().item() == pytest.approx(variance, rel=0.06, abs=1e-9)


def test_one_flow_step_by_hand():
    """From noise in one step: x0_hat = 0, r^2 = 1, so that the chunk becomes min(scale, 1) of the student's."""
    assert [pull_of_scale(flow_sampler(1), scale, "x0") for scale in (0.25, 1.0, 9.0)] == [0.25, 1.0, 1.0]


def test_the_trust_region_holds_back_a_distant_student():
    far = pull_of_scale(sampler("DDIM", 10), 2.0, "x0", SPREAD, 10 * DISTANCE)
    assert 0 < far < 0.7 * pull_of_scale(sampler("DDIM", 10), 2.0, "x0")


fractions = st.floats(0.02, 0.95)
samplers = st.tuples(st.sampled_from(["DDPM", "DDIM", "flow"]), st.integers(5, 50))


@given(samplers, fractions, st.sampled_from(["x0", "mu"]))
@settings(max_examples=25, deadline=None)
def test_the_scale_of_a_pull_pulls_so_far_and_no_smaller_one_does(kind_and_steps, fraction_of_largest, at):
    chain, at = sampler(*kind_and_steps), "x0" if kind_and_steps[0] == "flow" else at
    pull = fraction_of_largest * largest_pull(chain, at)
    scale = scale_of_pull(chain, pull, at)
    assert pull_of_scale(chain, scale, at) == pytest.approx(pull, abs=1e-6)
    assert all(pull_of_scale(chain, fraction * scale, at) < pull for fraction in (0.1, 0.5, 0.9, 0.99))


def test_a_pull_of_zero_is_no_guidance_and_one_out_of_reach_an_error():
    chain = sampler("DDPM", 5)
    assert scale_of_pull(chain, 0.0, "x0") == 0.0
    assert 0.5 < largest_pull(chain, "x0", spread=0.3) < 0.7
    assert scale_of_pull(chain, largest_pull(chain, "x0", spread=0.3), "x0", spread=0.3) > 0
    with pytest.raises(ValueError, match=r"the largest pull is 0.6\d*, not 0.8"):
        scale_of_pull(chain, 0.8, "x0", spread=0.3)


@pytest.mark.parametrize("kind", ["DDPM", "DDIM"])
def test_one_diffusion_step_cannot_be_guided(kind):
    assert not acts(sampler(kind, 1)) and largest_pull(sampler(kind, 1), "x0") == 0
    assert acts(sampler(kind, 2)) and acts(flow_sampler(1))


def test_describing_a_scheduler_leaves_it_as_it_is():
    plain = scheduler("DDIM")
    plain.set_timesteps(7)
    diffusion_sampler(plain, 10)
    assert plain.num_inference_steps == 7 and len(plain.timesteps) == 7
