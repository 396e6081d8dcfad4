"""The guided chain against closed forms: diffusers' own posterior, and a linear-Gaussian recursion."""

import math

import diffusers.schedulers.scheduling_ddpm as scheduling_ddpm
import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from hypothesis import given, settings, strategies as st
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionModel
from torch import nn

from lerobot_agpd.guidance import guide as guidance
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy
from lerobot_agpd.guidance.guide import Guide, GuidedScheduler, Posterior, guided, posterior

SCHEDULES = [("DDPM", 100), ("DDPM", 10), ("DDIM", 10)]


# ---- an exact denoiser and its chain in closed form ----


class ExactDenoiser(nn.Module):
    """Predicts noise, clean chunk or v (arXiv:2202.00512) exactly for data whose entries are N(mean, std^2)."""

    def __init__(self, mean: float, std: float, dtype: torch.dtype, prediction_type: str):
        super().__init__()
        self.mean, self.std, self.prediction_type = mean, std, prediction_type
        self.dtype_source = nn.Parameter(torch.zeros(1, dtype=dtype))
        self.alphas_cumprod = DDPMScheduler(100, beta_schedule="squaredcos_cap_v2").alphas_cumprod

    def forward(self, x, timestep, global_cond=None):
        abar = self.alphas_cumprod[int(timestep[0])]
        gain = self.std**2 * abar**0.5 / (abar * self.std**2 + 1 - abar)
        x0 = self.mean + gain * (x - abar**0.5 * self.mean)
        noise = (x - abar**0.5 * x0) / (1 - abar) ** 0.5
        v = abar**0.5 * noise - (1 - abar) ** 0.5 * x0
        return {"epsilon": noise, "sample": x0, "v_prediction": v}[self.prediction_type]


def exact_model(
    kind, n_steps, mean, std, dtype=torch.float64, clip=False, prediction_type="epsilon"
) -> DiffusionModel:
    """LeRobot's DiffusionModel, horizon 2 of which step 1 is the current one, around the exact denoiser."""
    config = DiffusionConfig(
        n_obs_steps=2,
        horizon=2,
        n_action_steps=1,
        down_dims=(8,),
        noise_scheduler_type=kind,
        num_train_timesteps=100,
        num_inference_steps=n_steps,
        clip_sample=clip,
        device="cpu",
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (1,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (1,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (1,))},
    )
    model = DiffusionModel(config)
    model.unet = ExactDenoiser(mean, std, dtype, prediction_type)
    # LeRobot's configuration refuses v_prediction, its schedulers know it
    model.noise_scheduler = type(model.noise_scheduler).from_config(
        model.noise_scheduler.config, prediction_type=prediction_type
    )
    return model


@pytest.fixture(autouse=True)
def unbounded(monkeypatch):
    """A trust region that never acts, as the closed forms have none."""
    monkeypatch.setattr(guidance, "TRUST_REGION", 1e9)


def guide_toward(target, scale, at="x0", **options) -> Guide:
    """J = 1/2 (A[1] - target)^2: the chunk's entry 0 lies in the past and is not guided."""
    goal = torch.full((len(scale), 1, 1), target, dtype=torch.float64)
    return Guide(ActionDiscrepancy(goal, start=1), torch.as_tensor(scale), at=at, **options)


def sample(model, guide, batch, seed=0, noise=None):
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad(), guided(model, guide):
        return model.conditional_sample(batch, generator=generator, noise=noise)


def cosine_alphas_cumprod() -> np.ndarray:
    """squaredcos_cap_v2 (arXiv:2102.09672), written down anew."""

    def f(u):
        return math.cos((u + 0.008) / 1.008 * math.pi / 2) ** 2

    return np.cumprod([1 - min(1 - f((i + 1) / 100) / f(i / 100), 0.999) for i in range(100)])


def closed_form(kind, n_steps, at, scale, mean, std, target) -> tuple[float, float]:
    """Mean and variance after the guided chain: every step maps x to slope * x + offset + sigma * z."""
    abars, stride = cosine_alphas_cumprod(), 100 // n_steps
    m, v = 0.0, 1.0
    for t in range(stride * (n_steps - 1), -1, -stride):
        abar, previous = abars[t], abars[t - stride] if t >= stride else 1.0
        alpha = abar / previous
        sigma2 = (1 - previous) / (1 - abar) * (1 - alpha)
        x0 = np.array([std**2 * abar**0.5 / (abar * std**2 + 1 - abar), 0.0])  # slope, offset of x0_hat
        x0[1] = mean * (1 - x0[0] * abar**0.5)
        x = np.array([1.0, 0.0])
        if kind == "DDPM":
            mu = (previous**0.5 * (1 - alpha) * x0 + alpha**0.5 * (1 - previous) * x) / (1 - abar)
        else:
            eps = (x - abar**0.5 * x0) / (1 - abar) ** 0.5
            mu = previous**0.5 * x0 + (1 - previous) ** 0.5 * eps
        point = x0 if at == "x0" else mu
        slope, offset = mu - min(scale * sigma2, 1) * (point - np.array([0.0, target]))
        m, v = slope * m + offset, slope**2 * v + (sigma2 if kind == "DDPM" else 0.0)
    return m, v


# ---- the posterior ----


@pytest.mark.parametrize("n_steps", [100, 16, 10, 1])
def test_posterior_of_ddpm_is_diffusers_own(n_steps, monkeypatch):
    scheduler = DDPMScheduler(100, beta_schedule="squaredcos_cap_v2", clip_sample=False)
    scheduler.set_timesteps(n_steps)
    monkeypatch.setattr(
        scheduling_ddpm, "randn_tensor", lambda shape, **_: torch.zeros(shape, dtype=torch.float64)
    )
    for t in scheduler.timesteps:
        x, noise = torch.randn(2, 3, 4, 2, dtype=torch.float64)
        output = scheduler.step(noise, t, x)
        step = posterior(scheduler, int(t), x, output.pred_original_sample, output.prev_sample)
        torch.testing.assert_close(step.mean, output.prev_sample, rtol=1e-3, atol=1e-5)
        expected = 0.0 if t == 0 else float(scheduler._get_variance(int(t)))
        assert step.variance == pytest.approx(expected, rel=1e-3)
        assert step.x0_hat is output.pred_original_sample
    assert step.variance == 0


@pytest.mark.parametrize("n_steps", [100, 16, 10, 1])
def test_posterior_of_ddim_is_its_mean_with_the_ddpm_variance(n_steps):
    scheduler = DDIMScheduler(100, beta_schedule="squaredcos_cap_v2", clip_sample=False)
    scheduler.set_timesteps(n_steps)
    abars, stride = cosine_alphas_cumprod(), 100 // n_steps
    for t in scheduler.timesteps.tolist():
        x, noise = torch.randn(2, 3, 4, 2, dtype=torch.float64)
        output = scheduler.step(noise, t, x)
        step = posterior(scheduler, t, x, output.pred_original_sample, output.prev_sample)
        previous = abars[t - stride] if t >= stride else 1.0
        x0 = (x - (1 - abars[t]) ** 0.5 * noise) / abars[t] ** 0.5
        expected = previous**0.5 * x0 + (1 - previous) ** 0.5 * noise
        torch.testing.assert_close(step.mean, expected, rtol=1e-3, atol=1e-3)
        assert torch.equal(step.mean, output.prev_sample)
        variance = (1 - previous) / (1 - abars[t]) * (1 - abars[t] / previous)
        assert step.variance == pytest.approx(variance, rel=1e-3)
        assert step.variance > 0 or t == 0
    assert step.variance == 0


def test_empirical_variance_of_ddpm_steps_is_the_posterior_variance():
    scheduler = DDPMScheduler(100, beta_schedule="squaredcos_cap_v2", clip_sample=False)
    scheduler.set_timesteps(10)
    for t in (90, 50, 10):
        x, noise = torch.full((40_000, 1, 1), 0.7), torch.full((40_000, 1, 1), 0.2)
        output = scheduler.step(noise, t, x, generator=torch.Generator().manual_seed(t))
        step = posterior(scheduler, t, x, output.pred_original_sample, output.prev_sample)
        spread = (output.prev_sample - step.mean).square().mean().item()
        assert spread == pytest.approx(step.variance, rel=4 * math.sqrt(2 / 40_000))
        assert output.prev_sample.mean().item() == pytest.approx(
            step.mean[0].item(), abs=4 * math.sqrt(step.variance / 40_000)
        )


# ---- the guided chain ----


@pytest.mark.parametrize("at", ["x0", "mu"])
@pytest.mark.parametrize(
    ("prediction_type", "scale"),
    [("epsilon", 0.3), ("epsilon", 1.0), ("epsilon", 4.0), ("sample", 1.0), ("v_prediction", 1.0)],
)
@pytest.mark.parametrize(("kind", "n_steps"), SCHEDULES)
def test_guided_chain_equals_its_linear_gaussian_recursion(kind, n_steps, prediction_type, scale, at):
    n, mean, std, target = 8_000, -0.2, 0.5, 0.7
    model = exact_model(kind, n_steps, mean, std, prediction_type=prediction_type)
    x = sample(model, guide_toward(target, [scale] * n, at), n, seed=5)[..., 0]
    for entry, k in ((0, 0.0), (1, scale)):  # entry 0 lies outside the executed window
        m, v = closed_form(kind, n_steps, at, k, mean, std, target)
        assert x[:, entry].mean().item() == pytest.approx(m, abs=4 * math.sqrt(v / n) + 1e-5)
        assert x[:, entry].var().item() == pytest.approx(v, rel=4 * math.sqrt(2 / n), abs=1e-9)


@pytest.mark.parametrize(("at", "mean", "variance"), [("mu", 0.058, 0.066), ("x0", 0.090, 0.077)])
def test_numbers_of_the_documentation(at, mean, variance):
    """Data N(0, 0.1), student at 0.3, 100 steps, scale 1; the exact tilt would be N(.027, .091)."""
    m, v = closed_form("DDPM", 100, at, 1.0, 0.0, math.sqrt(0.1), 0.3)
    assert (m, v) == (pytest.approx(mean, abs=5e-4), pytest.approx(variance, abs=5e-4))
    x = sample(exact_model("DDPM", 100, 0.0, math.sqrt(0.1)), guide_toward(0.3, [1.0] * 20_000, at), 20_000)
    assert x[:, 1].mean().item() == pytest.approx(m, abs=4 * math.sqrt(v / 20_000))


@pytest.mark.parametrize("at", ["x0", "mu"])
@pytest.mark.parametrize(("kind", "n_steps"), SCHEDULES)
def test_scale_zero_is_bit_identical_to_unguided(kind, n_steps, at, monkeypatch):
    monkeypatch.setattr(guidance, "TRUST_REGION", 1.0)
    model = exact_model(kind, n_steps, 0.1, 0.4, torch.float32, clip=True)
    own = model.noise_scheduler
    unguided = sample(model, None, 6)
    assert torch.equal(sample(model, guide_toward(0.9, [0.0] * 6, at), 6), unguided)
    mixed = sample(model, guide_toward(0.9, [0.0, 1.0, 0.0, 8.0, 0.0, 0.1], at), 6)
    assert torch.equal(mixed[[0, 2, 4]], unguided[[0, 2, 4]])
    assert (mixed[[1, 3, 5], 1] != unguided[[1, 3, 5], 1]).all()
    assert torch.equal(mixed[:, 0], unguided[:, 0])  # outside the executed window
    assert model.noise_scheduler is own


def test_the_model_gets_its_scheduler_back_after_an_error():
    model = exact_model("DDIM", 10, 0.0, 1.0)
    own = model.noise_scheduler
    with pytest.raises(RuntimeError, match="boom"), guided(model, guide_toward(0.0, [1.0])):
        assert isinstance(model.noise_scheduler, GuidedScheduler)
        raise RuntimeError("boom")
    assert model.noise_scheduler is own


# ---- what more guidance does ----

unit = st.floats(-1, 1)
spreads = st.floats(0.1, 1)
scales = st.tuples(st.floats(0, 16), st.floats(0, 16)).map(sorted)


def one_step(mu, x0, target, k, variance, trust, at):
    """Shifts of the guided entry in one step, for two scales."""
    step = Posterior(torch.full((2, 2, 1), mu), variance, torch.full((2, 2, 1), x0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guidance, "TRUST_REGION", trust)
        return guide_toward(target, k, at).shift(step, 50)[:, 1, 0]


@given(unit, unit, unit, scales, st.floats(0.01, 1), st.floats(0.1, 100))
@settings(deadline=None)
def test_one_step_at_mu_never_ends_farther_with_more_scale(mu, x0, target, k, variance, trust):
    shift = one_step(mu, x0, target, k, variance, trust, "mu")
    less, more = (mu + shift - target).abs().tolist()
    assert more <= less + 1e-6 and less <= abs(mu - target) + 1e-6


@given(unit, unit, unit, scales, st.floats(0.01, 1), st.floats(0.1, 100))
@settings(deadline=None)
def test_one_step_at_x0_moves_toward_the_student_and_not_past_it(mu, x0, target, k, variance, trust):
    less, more = one_step(mu, x0, target, k, variance, trust, "x0").tolist()
    gap = target - x0
    assert less * gap >= 0 and more * gap >= 0
    assert abs(less) <= abs(more) + 1e-6 and abs(more) <= abs(gap) + 1e-6


@given(unit, unit, spreads, scales)
@settings(max_examples=8, deadline=None)
def test_more_scale_never_moves_the_mean_farther_from_the_student(mean, target, std, k):
    """100 DDPM steps at x0, all noise at its mean (the chain is affine); strided chains can overshoot."""
    model = exact_model("DDPM", 100, mean, std)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scheduling_ddpm, "randn_tensor", lambda shape, **_: torch.zeros(shape))
        start = torch.zeros(3, 2, 1, dtype=torch.float64)
        x = sample(model, guide_toward(target, [0.0, *k]), 3, noise=start)
    own, less, more = (x[:, 1, 0] - target).abs().tolist()
    assert more <= less + 1e-3 and less <= own + 1e-3


@given(unit, unit, spreads, scales, st.sampled_from(["x0", "mu"]))
@settings(max_examples=20, deadline=None)
def test_more_scale_contracts_deterministic_chains(mean, target, std, k, at):
    """DDIM maps the initial noise affinely: chains from 0 and from 1 end closer together under more scale."""
    model = exact_model("DDIM", 10, mean, std)
    start = torch.zeros(4, 2, 1, dtype=torch.float64)
    start[2:] = 1.0
    x = sample(model, guide_toward(target, [*k, *k], at), 4, noise=start)[:, 1, 0]
    less, more = (x[2:] - x[:2]).abs().tolist()
    assert more <= less + 1e-6


# ---- trust region and callback ----


@pytest.mark.parametrize("at", ["x0", "mu"])
@pytest.mark.parametrize(("kind", "n_steps"), SCHEDULES)
def test_trust_region_bounds_every_step(kind, n_steps, at, monkeypatch):
    monkeypatch.setattr(guidance, "TRUST_REGION", 0.5)
    seen = []
    guide = guide_toward(1e6, [1e6] * 5, at, callback=seen.append)
    x = sample(exact_model(kind, n_steps, 0.0, 0.5), guide, 5)
    assert x.abs().max() < 20
    assert [step.timestep for step in seen] == list(range(100 - 100 // n_steps, -1, -(100 // n_steps)))
    for step in seen:
        assert step.shift.shape == step.x0_hat.shape == (5, 2, 1) and step.discrepancy.shape == (5,)
        assert torch.equal(step.shift[:, 0], torch.zeros(5, 1, dtype=torch.float64))
        rms = step.shift[:, 1].square().mean(dim=1).sqrt()  # over the guided entries
        assert (rms <= 0.5 * step.sigma * (1 + 1e-6)).all()
    assert seen[-1].sigma == 0 and (seen[-1].shift == 0).all()
    assert len(guide.shift_in_sigmas) == n_steps - 1
    assert torch.stack(guide.shift_in_sigmas).allclose(torch.tensor(0.5, dtype=torch.float64))


def test_shift_by_hand(monkeypatch):
    """scale 2, sigma^2 = 1/4: half of the gap, on the executed steps only; capped rows keep their direction."""
    seen, x0 = [], torch.zeros(2, 4, 2)
    target = torch.tensor([[[1.0, -2.0], [3.0, 0.0]]]).expand(2, 2, 2)
    guide = Guide(ActionDiscrepancy(target, 1), torch.tensor([2.0, 0.0]), "x0", seen.append)
    shift = guide.shift(Posterior(torch.full((2, 4, 2), 9.0), 0.25, x0), 7)
    assert shift[0].tolist() == [[0, 0], [0.5, -1], [1.5, 0], [0, 0]]
    assert (shift[1] == 0).all()
    assert seen[0].discrepancy.tolist() == [7.0, 7.0]  # (1 + 4 + 9) / 2
    monkeypatch.setattr(guidance, "TRUST_REGION", 0.1)
    capped = guide.shift(Posterior(x0, 0.25, x0), 7)[0]
    rms = math.sqrt((0.25 + 1 + 2.25) / 3)  # over the nonzero entries
    torch.testing.assert_close(capped, shift[0] * 0.1 * 0.5 / rms)
