"""What a collection strategy did to actions and states, measured after a round.

Success rates say what a strategy costs; these numbers say what it buys: how far it moves the teacher's actions
(Eq. 14) and how much of the state space the kept episodes visit (section 2).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.guidance.teacher import History
from lerobot_agpd.replay.episode import Array
from lerobot_agpd.replay.normalization import Statistics, floor_statistics
from lerobot_agpd.rollout.diversity import (
    Gaussian,
    gaussian_kl,
    knn_entropy,
    match_moments,
    standardize,
    state_coverage,
)
from lerobot_agpd.rollout.rollout import Decision
from lerobot_agpd.rollout.strategies import Strategy

N_OBSERVATIONS, N_SAMPLES = 32, 16
"""Decisions at which a study samples teacher and strategy again, and samples of both at each of them."""

ROUND_OBSERVATIONS, ROUND_SAMPLES = 16, 2
"""The same of a collection round, whose teacher has episodes to collect."""

MAX_STATES = 2000
"""Visited states, at most, whose diversity is measured."""

NEIGHBOR = 3
"""k of the nearest-neighbor entropy."""

EPSILON = 0.5
"""A state is covered if a recorded one is as near, in standard deviations per dimension."""

BLUR = 0.01
"""Standard deviation of the noise, in the teacher's units, that is added to both policies' actions before their
divergence is taken: a deterministic policy has no density, and neither has an action at its limit."""


@dataclass(frozen=True)
class RoundDiagnostics:
    """What a round's strategy did.

    Attributes:
        actions: `action_diagnostics` at a sample of the round's decisions; None if there was no decision.
        states: `state_diagnostics` of the kept episodes; None without any, or with images alone.
        seconds: what measuring took.
        teacher_samples: chunks that the teacher was sampled for it.
    """

    actions: Mapping[str, float] | None
    states: Mapping[str, Any] | None
    seconds: float
    teacher_samples: int = 0

    @property
    def scalars(self) -> dict[str, float]:
        """What the training log says of it."""
        shown = {
            "actions": ("rms_to_student", "rms_to_teacher", "kl_to_teacher_median"),
            "states": ("entropy", "coverage"),
        }
        return {
            f"{part}_{name}": value
            for part, names in shown.items()
            for name in names
            if (value := (getattr(self, part) or {}).get(name)) is not None
        }


class ObservationReservoir:
    """Reservoir-sample observations during a round, for its diagnostics.

    A uniform sample of the histories that a strategy decided at (algorithm R: Vitter, ACM TOMS 11(1), 1985), drawn
    with random numbers of its own, so that an episode is the same without it. Histories at which the student acted are
    left out.

    Args:
        seed: of the sample.
        size: histories to keep.
    """

    def __init__(self, seed: int, size: int = N_OBSERVATIONS):
        self.size = size
        self._rows: list[dict[str, Any]] = []
        self._n_seen = 0
        self._rng = np.random.default_rng([seed, size])

    def __call__(self, decision: Decision) -> None:
        """Take note of a decision; made to be a rollout's `on_decision`."""
        for row, student_acts in enumerate(decision.student_acts.tolist()):
            if not student_acts:
                self._add(decision.history, row)

    def _add(self, history: History, row: int) -> None:
        self._n_seen += 1
        place = len(self._rows) if len(self._rows) < self.size else int(self._rng.integers(self._n_seen))
        if place < self.size:
            kept = {key: value[row] for key, value in history.items()}
            self._rows[place : place + 1] = [kept]

    def history(self) -> dict[str, Any] | None:
        """The sampled histories as one, (at most `size`, n_obs_steps, ...); None before the first decision."""
        if not self._rows:
            return None
        return {
            key: torch.stack([row[key] for row in self._rows])
            if isinstance(first, Tensor)
            else [row[key] for row in self._rows]
            for key, first in self._rows[0].items()
        }


# ---- actions ----


def action_diagnostics(
    strategy: Strategy, history: History, strength: float, seed: int, samples: int = N_SAMPLES
) -> dict[str, float]:
    """Where the executed chunks lie between the teacher's and the student's, at given observations.

    Strategy and teacher are sampled in pairs from the same noise, so that a strategy that leaves the teacher alone
    is at distance 0 and divergence 0.

    Args:
        strategy: its own noise and stopwatch are left alone.
        history: observations (B, T, ...).
        strength: pull, guidance scale or mixing weight.
        seed: of the noise.
        samples: number K of samples at each observation.

    Returns:
        Root-mean-square distances in the teacher's units; `teacher_spread`, the standard deviation of the teacher's
        own samples (sigma_E of docs/theory.md: guidance cannot move a teacher that is certain); the KL
        divergence of the executed actions from the teacher's in nats, mean and median over observations and
        executed steps.
    """
    generator = torch.Generator(device=strategy.generator.device).manual_seed(seed)
    repeated = strategy.reseeded(generator)
    normalize = repeated.pair.teacher.normalize
    student = normalize(repeated.pair.student_actions(history)).cpu()  # (B, n, A)
    strengths = torch.full((len(student),), strength)
    alone, executed = [], []
    for _ in range(samples):
        noise = generator.get_state()
        alone.append(normalize(repeated.pair.teacher_actions(history, generator)).cpu())
        generator.set_state(noise)
        executed.append(normalize(repeated.act(history, strengths).actions).cpu())
    of_teacher, of_strategy = torch.stack(alone), torch.stack(executed)  # (K, B, n, A)
    divergence = action_kl(of_strategy, of_teacher)
    return {
        "observations": len(student),
        "teacher_samples": repeated.stopwatch.counts["teacher"],
        "rms_to_student": _rms(of_strategy - student),
        "rms_to_teacher": _rms(of_strategy - of_teacher),
        "rms_teacher_to_student": _rms(of_teacher - student),
        "teacher_spread": sample_spread(of_teacher),
        "kl_to_teacher": float(divergence.mean()),
        "kl_to_teacher_median": float(np.median(divergence)),
    }


def sample_spread(samples: Tensor) -> float:
    """Standard deviation of samples (K, ...) of one state or of several, over all their entries (sigma_E)."""
    return float(samples.var(dim=0).mean().sqrt())


def action_kl(actions: Tensor, reference: Tensor) -> Array:
    """KL divergence of moment-matched Gaussians over single actions (Eq. 14), (B * n,) in nats.

    With fewer samples than a covariance needs, all observations and steps share one.

    Args:
        actions: (K, B, n, A) samples, in the teacher's units.
        reference: samples of the teacher, of the same shape.
    """
    ours, theirs = (
        samples.permute(1, 2, 0, 3).flatten(0, 1).double().numpy() for samples in (actions, reference)
    )
    pairs = zip(_gaussians(ours), _gaussians(theirs), strict=True)
    return np.array([gaussian_kl(p, q) for p, q in pairs])


def _gaussians(samples: Array) -> list[Gaussian]:
    """Gaussians of samples (N, K, A) plus noise of standard deviation BLUR, one for each of the N."""
    count, dim = samples.shape[1:]
    if count > dim:
        return [_blurred(own) for own in samples]
    means = samples.mean(axis=1)
    residuals = (samples - means[:, None]).reshape(-1, dim)
    shared = residuals.T @ residuals / max(1, len(samples) * (count - 1))
    return [Gaussian(mean, shared + BLUR**2 * np.eye(dim)) for mean in means]


def _blurred(samples: Array) -> Gaussian:
    """Gaussian of samples (K, A) plus noise of standard deviation BLUR."""
    dim = samples.shape[1]
    if np.ptp(samples, axis=0).any():
        matched = match_moments(samples)
    else:
        matched = Gaussian(samples.mean(axis=0), np.zeros((dim, dim)))
    return Gaussian(matched.mean, matched.covariance + BLUR**2 * np.eye(dim))


def _rms(gap: Tensor) -> float:
    return float(gap.square().mean().sqrt())


# ---- states ----


def state_diagnostics(
    episodes: Iterable[Mapping[str, Array]], stats: Statistics, seed: int
) -> dict[str, Any] | None:
    """How diverse the low-dimensional states of episodes are, in the demonstrations' standard deviations.

    Args:
        episodes: observations of the kept ones, feature name to (T, D).
        stats: statistics of the demonstrations.
        seed: of the choice of states.

    Returns:
        `entropy`, from nearest neighbors, of at most MAX_STATES distinct states (`states`, `dim`), and
        `coverage`: the fraction of the next states in every second episode with a state of the other episodes
        within a root-mean-square EPSILON (P_S of section 2, held out). None for what there are too few states for, and
        if observations are images only.
    """
    paths = [state_path(observations, stats) for observations in episodes]
    if not paths or paths[0].shape[1] == 0:
        return None
    rng = np.random.default_rng(seed)
    visited = at_most(MAX_STATES, np.unique(np.concatenate(paths), axis=0), rng)
    return {
        "states": len(visited),
        "dim": visited.shape[1],
        "entropy": knn_entropy(visited, NEIGHBOR) if len(visited) > NEIGHBOR else None,
        "coverage": _held_out_coverage(paths, rng),
    }


def state_path(observations: Mapping[str, Array], stats: Statistics) -> Array:
    """All vectors of an episode side by side, (T, D), standardized."""
    vectors = {key: value for key, value in observations.items() if value.ndim == 2 and key in stats}
    floored = floor_statistics({key: stats[key] for key in vectors})
    columns = [
        standardize(vectors[key], floored[key]["mean"], floored[key]["std"]) for key in sorted(vectors)
    ]
    length = len(next(iter(observations.values())))
    return np.concatenate(columns, axis=1) if columns else np.empty((length, 0))


def _held_out_coverage(paths: Sequence[Array], rng: np.random.Generator) -> float | None:
    tested = [path[1:] for path in paths[1::2] if len(path) > 1]
    if not tested:
        return None
    test, train = (at_most(MAX_STATES, np.concatenate(part), rng) for part in (tested, paths[::2]))
    return state_coverage(test, train, EPSILON * math.sqrt(test.shape[1]))


def at_most(n_states: int, states: Array, rng: np.random.Generator) -> Array:
    """A random choice of `n_states` rows, or all."""
    return states if len(states) <= n_states else states[rng.choice(len(states), n_states, replace=False)]
