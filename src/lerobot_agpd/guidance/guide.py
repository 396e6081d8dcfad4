"""Guidance as a small object around a denoising step (Eq. 20, sign and DDIM repaired).

One reverse step of the teacher has posterior mean mu and variance sigma^2. Guided, it becomes

    x_{k-1} = mu - scale * sigma^2 * grad J + sigma * z,

so that a positive scale moves the chunk *toward* the student. The sampling loop stays LeRobot's: the guide
adds a shift to what the scheduler's `step` returns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from torch import Tensor, nn

from lerobot_agpd.config import GuidancePoint
from lerobot_agpd.guidance.discrepancy import Discrepancy

TRUST_REGION = 1.0
"""Largest shift of a denoising step, as a multiple of that step's sigma."""


@dataclass(frozen=True)
class Posterior:
    """A reverse step k -> k-1: its mean (B, H, A), its variance and the clean chunk x0_hat it assumes."""

    mean: Tensor
    variance: float
    x0_hat: Tensor


def posterior(
    scheduler: DDPMScheduler | DDIMScheduler, timestep: int, x_t: Tensor, x0_hat: Tensor, prev_sample: Tensor
) -> Posterior:
    """Posterior of a diffusers DDPM or DDIM step, with strided schedules (DDPM, arXiv:2006.11239, Eq. 6-7).

    At eta = 0, DDIM adds no noise and its own sigma is 0, which would switch guidance off; sigma^2 is
    therefore always the DDPM posterior variance between the two noise levels of the step.

    Args:
        scheduler: a DDPMScheduler or DDIMScheduler whose timesteps are set.
        timestep: k.
        x_t: (B, H, A) the noisy chunk before the step.
        x0_hat: (B, H, A) the predicted clean chunk (clipped, if the scheduler clips).
        prev_sample: (B, H, A) the scheduler's own result; DDIM's is its mean.
    """
    abar, abar_previous = noise_levels(scheduler, timestep)
    alpha, variance = abar / abar_previous, posterior_variance(abar, abar_previous)
    if isinstance(scheduler, DDIMScheduler):
        mean = prev_sample
    else:
        mean = (
            abar_previous**0.5 * (1 - alpha) / (1 - abar) * x0_hat
            + alpha**0.5 * (1 - abar_previous) / (1 - abar) * x_t
        )
    return Posterior(mean=mean, variance=variance, x0_hat=x0_hat)


def noise_levels(scheduler: DDPMScheduler | DDIMScheduler, timestep: int) -> tuple[float, float]:
    """abar, the cumulative product of the noise schedule, before and after the reverse step of a (strided) schedule."""
    if isinstance(scheduler, DDIMScheduler):
        previous = timestep - scheduler.config.num_train_timesteps // scheduler.num_inference_steps
    else:
        previous = int(scheduler.previous_timestep(timestep))
    abar = float(scheduler.alphas_cumprod[timestep])
    return abar, float(scheduler.alphas_cumprod[previous]) if previous >= 0 else 1.0


def posterior_variance(abar: float, abar_previous: float) -> float:
    """sigma^2 of a reverse step between two noise levels (DDPM, arXiv:2006.11239, Eq. 7)."""
    return (1 - abar_previous) / (1 - abar) * (1 - abar / abar_previous)


@dataclass(frozen=True)
class GuidedStep:
    """What a guide did in one step.

    Attributes:
        timestep: diffusion step k, or the time tau of a flow.
        sigma: standard deviation of the step.
        discrepancy: (B,) J where it was differentiated.
        shift: (B, H, A) what was added.
        x0_hat: (B, H, A) the predicted clean chunk.
    """

    timestep: float
    sigma: float
    discrepancy: Tensor
    shift: Tensor
    x0_hat: Tensor


@dataclass
class Guide:
    """Pulls a teacher's chunks toward the student's.

    Attributes:
        discrepancy: J as a function of the teacher's chunk.
        scale: (B,) guidance scale k of every row; rows at 0 are sampled exactly as without a guide.
        at: where J is differentiated.
        callback: called with every step's GuidedStep, to look inside.
        shift_in_sigmas: per step, (B,) root-mean-square shift divided by sigma; filled while sampling.
    """

    discrepancy: Discrepancy
    scale: Tensor
    at: GuidancePoint = "x0"
    callback: Callable[[GuidedStep], None] | None = None
    shift_in_sigmas: list[Tensor] = field(default_factory=list)

    @property
    def acts(self) -> bool:
        """Whether any row is guided."""
        return bool((self.scale > 0).any())

    def shift(self, step: Posterior, timestep: float) -> Tensor:
        """What to add to x_{k-1} (of a flow: to x0_hat), (B, H, A).

        Two caps make up the trust region. scale * sigma^2 is cut at 1, where the explicit step of the
        quadratic J lands on the student (beyond 2 it would diverge). Then the step's length is cut at
        TRUST_REGION sigmas, so that a guided step stays as likely as a large draw of the teacher's noise.
        """
        point = step.x0_hat if self.at == "x0" else step.mean
        grad = self.discrepancy.gradient(point)
        sigma = step.variance**0.5
        factor = (self.scale * step.variance).clamp(max=1.0).to(grad)  # (B,)
        shift = -factor[:, None, None] * grad  # (B, H, A)
        length = _rms_over_nonzero(shift)  # (B,)
        cap = (TRUST_REGION * sigma / length.clamp_min(1e-12)).clamp(max=1.0)
        shift = shift * cap[:, None, None]
        if sigma > 0:
            self.shift_in_sigmas.append(length * cap / sigma)
        if self.callback is not None:
            self.callback(GuidedStep(timestep, sigma, self.discrepancy(point), shift, step.x0_hat))
        return shift


class GuidedScheduler:
    """A diffusers scheduler whose `step` is shifted by a guide; everything else is the scheduler's."""

    def __init__(self, scheduler: Any, guide: Guide):
        self._scheduler = scheduler
        self._guide = guide

    def __getattr__(self, name: str) -> Any:
        """Defer to the wrapped scheduler."""
        return getattr(self._scheduler, name)

    def step(self, model_output: Tensor, timestep: int, sample: Tensor, **kwargs: Any) -> Any:
        """One guided reverse step; the same output object as the wrapped scheduler's."""
        output = self._scheduler.step(model_output, timestep, sample, **kwargs)
        step = posterior(
            self._scheduler, int(timestep), sample, output.pred_original_sample, output.prev_sample
        )
        output.prev_sample = output.prev_sample + self._guide.shift(step, int(timestep))
        return output


@contextmanager
def guided(model: nn.Module, guide: Guide | None) -> Iterator[None]:
    """Sample from a LeRobot DiffusionModel under a guide; without one, or at scale 0, the model is untouched."""
    if guide is None or not guide.acts:
        yield
        return
    scheduler = model.noise_scheduler
    model.noise_scheduler = GuidedScheduler(scheduler, guide)  # type: ignore[assignment]
    try:
        yield
    finally:
        model.noise_scheduler = scheduler


def _rms_over_nonzero(shift: Tensor) -> Tensor:
    """Root mean square of every row over its nonzero entries, (B,): unguided steps do not dilute it."""
    flat = shift.flatten(1)
    count = flat.count_nonzero(dim=1).clamp_min(1)
    return (flat.square().sum(dim=1) / count).sqrt()
