"""Guided flows against their own linear recursion, in both of LeRobot's flow integrators."""

import math

import pytest
import torch
from hypothesis import given, strategies as st
from lerobot.policies.common.flow_matching import euler_integrate
from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
from lerobot.policies.multi_task_dit.modeling_multi_task_dit import FlowMatchingObjective
from torch import nn

from lerobot_agpd.guidance import guide as guidance
from lerobot_agpd.guidance.adapters.flow import GuidedVelocity
from lerobot_agpd.guidance.adapters.rtc import VelocityGuide
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy
from lerobot_agpd.guidance.flow import clean_variance, guided_velocity
from lerobot_agpd.guidance.guide import Guide

MEAN, STD, TARGET = -0.2, 0.5, 0.7


class ExactVelocity(nn.Module):
    """dx / dtau of the flow whose data are N(MEAN, STD^2): E[x0 | x] - E[noise | x]."""

    def __init__(self, dtype=torch.float64):
        super().__init__()
        self.dtype_source = nn.Parameter(torch.zeros(1, dtype=dtype))

    def forward(self, x, time, conditioning_vec=None):
        tau = float(time[0])
        spread = (1 - tau) ** 2 + tau**2 * STD**2  # variance of x
        x0 = MEAN + tau * STD**2 / spread * (x - tau * MEAN)
        noise = (1 - tau) / spread * (x - tau * MEAN)
        return x0 - noise


def closed_form(n_steps, scale, target=TARGET) -> tuple[float, float]:
    """The Euler chain as one affine map of the noise: x -> slope * x + offset at every step."""
    slope, offset, dt = 1.0, 0.0, 1 / n_steps
    for step in range(n_steps):
        tau = step * dt
        gain = tau * STD**2 / ((1 - tau) ** 2 + tau**2 * STD**2)
        x0 = (gain, MEAN * (1 - gain * tau))  # x0_hat = gain * x + MEAN * (1 - gain * tau)
        r2 = (1 - tau) ** 2 / (tau**2 + (1 - tau) ** 2)
        weight = min(scale * r2, 1)
        led_to = ((1 - weight) * x0[0], (1 - weight) * x0[1] + weight * target)
        fraction = dt / (1 - tau)  # of the way from x to where the velocity leads
        slope, offset = (
            (1 - fraction + fraction * led_to[0]) * slope,
            (1 - fraction + fraction * led_to[0]) * offset + fraction * led_to[1],
        )
    return slope, offset


@pytest.fixture(autouse=True)
def unbounded(monkeypatch):
    """A trust region that never acts, as the closed forms have none."""
    monkeypatch.setattr(guidance, "TRUST_REGION", 1e9)


def guide_toward(target, scale, dims=1, **options) -> Guide:
    """J = 1/2 ||A[1] - target||^2: the chunk's step 0 is not guided."""
    goal = torch.full((len(scale), 1, dims), target, dtype=torch.float64)
    return Guide(ActionDiscrepancy(goal, 1), torch.as_tensor(scale), **options)


def objective(n_steps, method="euler") -> FlowMatchingObjective:
    config = MultiTaskDiTConfig(
        objective="flow_matching", num_integration_steps=n_steps, integration_method=method, device="cpu"
    )
    return FlowMatchingObjective(config, action_dim=1, horizon=2)


def sample_objective(n_steps, guide, batch, method="euler", dtype=torch.float64, seed=0):
    """LeRobot's own sampler of multi_task_dit: chunks (B, 2, 1) and the noise they came from."""
    model = ExactVelocity(dtype)
    torch.manual_seed(seed)
    noise = torch.randn(batch, 2, 1, dtype=dtype)
    torch.manual_seed(seed)
    model = model if guide is None else GuidedVelocity(model, guide)
    return objective(n_steps, method).conditional_sample(model, batch, None), noise


def sample_rtc(n_steps, guide, noise, action_dim=1):
    """LeRobot's own sampler of pi0, pi05 and smolvla, whose time runs backwards."""
    processor = None if guide is None else VelocityGuide(guide, action_dim)
    model = ExactVelocity(noise.dtype)
    with torch.no_grad():
        return euler_integrate(
            lambda x, time: -model(x, (1 - time.double()).to(x)),
            noise,
            n_steps,
            rtc_processor=processor,
            rtc_enabled=guide is not None,
        )


def test_clean_variance_by_hand():
    assert clean_variance(0.0) == 1 and clean_variance(1.0) == 0
    assert clean_variance(0.5) == pytest.approx(0.5)
    assert clean_variance(0.75) == pytest.approx(1 / 10)


@given(st.floats(0.01, 0.99))
def test_clean_variance_is_the_posterior_variance_of_unit_gaussians(tau):
    """x = (1 - tau) n + tau x0 with n, x0 ~ N(0, 1): Var(x0) - Cov(x0, x)^2 / Var(x)."""
    assert clean_variance(tau) == pytest.approx(1 - tau**2 / (tau**2 + (1 - tau) ** 2))


def test_one_guided_velocity_by_hand():
    """tau = 1/2: x0_hat = 1 + 2/2 = 2, r^2 = 1/2, scale 1: shift = -(2 - 4)/2 = 1, over 1 - tau: 2."""
    steps = []
    guide = guide_toward(4.0, [1.0, 0.0], callback=steps.append)
    x, velocity = torch.full((2, 2, 1), 1.0), torch.full((2, 2, 1), 2.0)
    bent = guided_velocity(guide, x, velocity, 0.5, action_dim=1)
    assert bent.tolist() == [[[2.0], [4.0]], [[2.0], [2.0]]]
    assert steps[0].discrepancy.tolist() == [2.0, 2.0]
    assert guide.shift_in_sigmas[0].tolist() == pytest.approx([math.sqrt(2), 0.0])
    assert guided_velocity(guide, x, velocity, 1.0, action_dim=1) is velocity


# ---- the guided chain ----


@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("n_steps", [1, 4, 10, 100])
def test_guided_objective_equals_its_linear_recursion(n_steps, scale):
    n = 20_000
    x, noise = sample_objective(n_steps, guide_toward(TARGET, [scale] * n), n)
    x = x[..., 0]
    for entry, k in ((0, 0.0), (1, scale)):
        slope, offset = closed_form(n_steps, k)
        torch.testing.assert_close(x[:, entry], slope * noise[:, entry, 0] + offset, rtol=1e-4, atol=1e-5)
        variance = slope**2
        assert x[:, entry].mean().item() == pytest.approx(offset, abs=4 * abs(slope) / math.sqrt(n) + 1e-5)
        assert x[:, entry].var().item() == pytest.approx(variance, rel=4 * math.sqrt(2 / n), abs=1e-9)
    product = abs(closed_form(n_steps, 0.0)[0] * closed_form(n_steps, scale)[0])
    assert x.T.cov()[0, 1].item() == pytest.approx(0, abs=4 * product / math.sqrt(n) + 1e-9)


@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("n_steps", [1, 4, 10, 100])
def test_guided_rtc_chain_equals_its_linear_recursion(n_steps, scale):
    noise = torch.randn(64, 2, 1, dtype=torch.float64)
    x = sample_rtc(n_steps, guide_toward(TARGET, [scale] * 64), noise)
    for entry, k in ((0, 0.0), (1, scale)):
        slope, offset = closed_form(n_steps, k)
        torch.testing.assert_close(x[:, entry], slope * noise[:, entry] + offset, rtol=1e-4, atol=1e-5)


def test_the_unguided_flow_reaches_the_data():
    """A check of the exact velocity itself: with many steps the chain is N(MEAN, STD^2)."""
    slope, offset = closed_form(2000, 0.0)
    assert (offset, abs(slope)) == (pytest.approx(MEAN, abs=1e-3), pytest.approx(STD, abs=1e-2))


@given(st.integers(2, 30), st.tuples(st.floats(0, 50), st.floats(0, 50)).map(sorted))
def test_more_scale_brings_the_mean_nearer_to_the_student(n_steps, scales):
    less, more = (abs(closed_form(n_steps, k)[1] - TARGET) for k in scales)
    assert more <= less + 1e-12


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_scale_zero_is_bit_identical_in_the_objective(method, monkeypatch):
    monkeypatch.setattr(guidance, "TRUST_REGION", 1.0)
    unguided, _ = sample_objective(8, None, 6, method, torch.float32)
    for scale in ([0.0] * 6, [0.0, 1.0, 0.0, 8.0, 0.0, 0.1]):
        x, _ = sample_objective(8, guide_toward(TARGET, scale), 6, method, torch.float32)
        at_zero = torch.tensor(scale) == 0
        assert torch.equal(x[at_zero], unguided[at_zero])
        assert torch.equal(x[:, 0], unguided[:, 0])  # outside the executed window
        assert ((x[~at_zero, 1] - unguided[~at_zero, 1]) > 0).all()  # TARGET lies above the data


def test_scale_zero_is_bit_identical_in_the_rtc_chain():
    noise = torch.randn(4, 2, 1)
    unguided = sample_rtc(8, None, noise)
    assert torch.equal(sample_rtc(8, guide_toward(TARGET, [0.0] * 4), noise), unguided)
    mixed = sample_rtc(8, guide_toward(TARGET, [0.0, 1.0, 0.0, 4.0]), noise)
    assert torch.equal(mixed[[0, 2]], unguided[[0, 2]])
    assert (mixed[[1, 3], 1] != unguided[[1, 3], 1]).all()


def test_padded_dimensions_are_not_guided():
    noise = torch.randn(5, 2, 7)
    unguided = sample_rtc(8, None, noise)
    x = sample_rtc(8, guide_toward(TARGET, [1.0] * 5, dims=2), noise, action_dim=2)
    assert torch.equal(x[..., 2:], unguided[..., 2:])
    assert (x[:, 1, :2] != unguided[:, 1, :2]).all()


# ---- trust region and callback ----


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_trust_region_bounds_every_step(method, monkeypatch):
    monkeypatch.setattr(guidance, "TRUST_REGION", 0.5)
    seen = []
    guide = guide_toward(1e6, [1e6] * 5, callback=seen.append)
    x, _ = sample_objective(10, guide, 5, method)
    assert x.abs().max() < 10  # the data, plus at most half a sigma at every step
    for step in seen:
        assert step.sigma == pytest.approx(math.sqrt(clean_variance(step.timestep)))
        rms = step.shift[:, 1].square().mean(dim=1).sqrt()
        torch.testing.assert_close(rms, torch.full_like(rms, 0.5 * step.sigma))
        assert (step.shift[:, 0] == 0).all()
    if method == "euler":
        assert [step.timestep for step in seen] == pytest.approx([k / 10 for k in range(10)])
        assert len(guide.shift_in_sigmas) == 10


def test_without_a_trust_region_any_scale_lands_on_the_student():
    """Beyond the stability limit of the explicit step (scale r^2 = 2) the cut at 1 keeps the chain bounded."""
    x, _ = sample_objective(10, guide_toward(TARGET, [1e6] * 5), 5)
    torch.testing.assert_close(x[:, 1], torch.full((5, 1), TARGET, dtype=torch.float64))


def test_the_network_is_not_differentiated():
    class Spy(ExactVelocity):
        def forward(self, x, time, conditioning_vec=None):
            assert not torch.is_grad_enabled() and not x.requires_grad
            return super().forward(x, time)

    model = GuidedVelocity(Spy(), guide_toward(TARGET, [1.0]))
    with torch.no_grad():
        x = objective(3).conditional_sample(model, 1, None)
    assert not x.requires_grad
