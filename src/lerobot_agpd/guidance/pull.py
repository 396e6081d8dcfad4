"""How far a guidance scale pulls, and which scale pulls as far as is wanted.

The same scale acts differently with other steps, schedulers, flows, and places where J is differentiated. What means
the same everywhere is the *pull*: the fraction of the way from the teacher to the student that the mean of a guided
chunk goes, 0 at the teacher, 1 at the student. It is computed for a teacher that denoises exactly, whose chunks have
independent entries N(0, SPREAD^2), and a student DISTANCE away in every entry. Each reverse step is then linear,

    x0_hat = gain * x,    x' = from_x0 * x0_hat + from_x * x + weight * shift + noise,

so that mean and variance of the chain follow by recursion. Both caps of guide.py are in it: the cap of a step's factor
at 1 exactly, the trust region as for a chunk of many entries, whose root-mean-square shift is its expectation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from lerobot_agpd.config import GuidancePoint
from lerobot_agpd.guidance import guide
from lerobot_agpd.guidance.flow import clean_variance
from lerobot_agpd.guidance.guide import noise_levels, posterior_variance

SPREAD = 0.15
"""Standard deviation of the reference teacher's chunks, in the teacher's normalized space.

About what a trained teacher of three ways has. With a larger one the strengths that make it choose would lie beyond 1
("How far guidance pulls" in docs/method.md).
"""

DISTANCE = 0.3
"""Distance of the reference student in every entry. It matters only where the trust region acts."""

SCALES = np.geomspace(1e-3, 1e4, 400)
"""Scales among which the one that pulls far enough is searched; beyond, every step is at its caps."""


@dataclass(frozen=True)
class ReverseStep:
    """A reverse step x -> x' of a sampler, as numbers.

    Attributes:
        signal: a of x = a x0 + b noise.
        noise: b.
        from_x0: factor of x0_hat in x' without guidance and noise.
        from_x: factor of x.
        variance: sigma^2 of Eq. 20.
        weight: factor of the guide's shift in x'.
        added: variance of the noise that the step adds.
    """

    signal: float
    noise: float
    from_x0: float
    from_x: float
    variance: float
    weight: float
    added: float

    def gain(self, spread: float) -> float:
        """E[x0 | x] = gain * x for data N(0, spread^2)."""
        return self.signal * spread**2 / (self.signal**2 * spread**2 + self.noise**2)


Sampler = tuple[ReverseStep, ...]
"""All reverse steps of a sampler, the noisiest first."""


# ---- samplers ----


def diffusion_sampler(scheduler: DDPMScheduler | DDIMScheduler, n_steps: int) -> Sampler:
    """The steps of a diffusers scheduler, which is left as it is (DDPM, arXiv:2006.11239; DDIM, arXiv:2010.02502)."""
    copied = deepcopy(scheduler)
    copied.set_timesteps(n_steps)
    return tuple(_diffusion_step(copied, int(timestep)) for timestep in copied.timesteps)


def _diffusion_step(scheduler: DDPMScheduler | DDIMScheduler, timestep: int) -> ReverseStep:
    abar, abar_previous = noise_levels(scheduler, timestep)
    variance, alpha = posterior_variance(abar, abar_previous), abar / abar_previous
    deterministic = isinstance(scheduler, DDIMScheduler)
    if deterministic:
        from_x = math.sqrt((1 - abar_previous) / (1 - abar))
        from_x0 = math.sqrt(abar_previous) - math.sqrt(abar) * from_x
    else:
        from_x = math.sqrt(alpha) * (1 - abar_previous) / (1 - abar)
        from_x0 = math.sqrt(abar_previous) * (1 - alpha) / (1 - abar)
    return ReverseStep(
        signal=math.sqrt(abar),
        noise=math.sqrt(1 - abar),
        from_x0=from_x0,
        from_x=from_x,
        variance=variance,
        weight=1.0,
        added=0.0 if deterministic else variance,
    )


def flow_sampler(n_steps: int) -> Sampler:
    """The Euler steps of a flow: each goes the fraction dt / (1 - tau) of the way to x0_hat, shifted (flow.py)."""
    times = np.arange(n_steps) / n_steps
    fractions = 1 / (n_steps * (1 - times))
    return tuple(
        ReverseStep(
            signal=float(tau),
            noise=float(1 - tau),
            from_x0=float(fraction),
            from_x=float(1 - fraction),
            variance=clean_variance(float(tau)),
            weight=float(fraction),
            added=0.0,
        )
        for tau, fraction in zip(times, fractions, strict=True)
    )


# ---- scale and pull ----


def chain_moments(
    sampler: Sampler, scale: ArrayLike, at: GuidancePoint, spread: float = SPREAD, distance: float = DISTANCE
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Mean and variance of an entry of a guided chunk, for data N(0, spread^2) and a student at `distance`.

    For an array of scales they are arrays too.
    """
    scale = np.asarray(scale, dtype=float)
    mean, variance = np.zeros_like(scale), np.ones_like(scale)
    for step in sampler:
        gain = step.gain(spread)
        slope = step.from_x0 * gain + step.from_x  # of x' without guidance
        point = gain if at == "x0" else slope  # of where J is differentiated
        shift = np.minimum(scale * step.variance, 1.0)
        rms = shift * np.sqrt((point * mean - distance) ** 2 + point**2 * variance)
        cap = guide.TRUST_REGION * math.sqrt(step.variance) / np.maximum(rms, 1e-12)
        shift = step.weight * shift * np.minimum(cap, 1.0)
        mean = (slope - shift * point) * mean + shift * distance
        variance = (slope - shift * point) ** 2 * variance + step.added
    return mean, variance


def pull_of_scale(
    sampler: Sampler, scale: float, at: GuidancePoint, spread: float = SPREAD, distance: float = DISTANCE
) -> float:
    """Fraction of the way to the student that a scale carries the mean of a chunk; beyond 1, past the student."""
    return float(chain_moments(sampler, scale, at, spread, distance)[0]) / distance


@lru_cache(maxsize=256)
def scale_of_pull(
    sampler: Sampler, pull: float, at: GuidancePoint, spread: float = SPREAD, distance: float = DISTANCE
) -> float:
    """The smallest scale that pulls so far.

    Raises:
        ValueError: if none does.
    """
    if pull == 0:
        return 0.0
    pulls = chain_moments(sampler, SCALES, at, spread, distance)[0] / distance
    enough = pulls >= pull
    if not enough.any():
        raise ValueError(f"the largest pull is {pulls.max():.3g}, not {pull:.3g}")
    first = int(enough.argmax())
    low = SCALES[first - 1] if first else 0.0
    found = brentq(
        lambda scale: pull_of_scale(sampler, scale, at, spread, distance) - pull,
        low,
        SCALES[first],
        xtol=1e-9,
    )
    return float(found)


@lru_cache(maxsize=64)
def largest_pull(
    sampler: Sampler, at: GuidancePoint, spread: float = SPREAD, distance: float = DISTANCE
) -> float:
    """The largest pull of any scale, 0 for a sampler that no scale can pull."""
    return float(chain_moments(sampler, SCALES, at, spread, distance)[0].max()) / distance


def acts(sampler: Iterable[ReverseStep]) -> bool:
    """Whether guidance can act at all: a step's shift is a multiple of its variance."""
    return any(step.variance > 0 for step in sampler)
