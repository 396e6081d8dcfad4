"""What a collection strategy did to actions and states, measured after a round.

Success rates say what a strategy costs; these numbers say what it buys: how far it moves the teacher's actions
(Eq. 14) and how much of the state space the kept episodes visit (section 2).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_agpd.studies.diversity import (
    Gaussian,
    gaussian_kl,
    knn_entropy,
    match_moments,
    standardize,
    state_coverage,
)
from lerobot_agpd.collect.config import DiagnosticsConfig
from lerobot_agpd.collect.deciders.pair import PairDecider
from lerobot_agpd.guidance.teacher import History
from lerobot_agpd.replay.episode import Array, Episode
from lerobot_agpd.replay.normalisation import Statistics, floor_statistics

BLUR = 0.01
"""Standard deviation of the noise, in the teacher's units, that is added to both policies' actions before their
divergence is taken: a deterministic policy has no density, and neither has an action at its limit."""


# ---- actions ----


def action_diagnostics(
    decider: PairDecider, history: History, strength: float, samples: int, seed: int
) -> dict[str, float]:
    """Where the executed chunks lie between the teacher's and the student's, at given observations.

    Strategy and unguided teacher are sampled in pairs from the same noise, so that a strategy that leaves the
    teacher alone is at distance 0 and divergence 0.

    Args:
        decider: the strategy; its own noise and stopwatch are left alone.
        history: observations (B, T, ...).
        strength: guidance scale or mixing weight.
        samples: number S of samples at each observation.
        seed: of the noise.

    Returns:
        Root-mean-square distances in the teacher's units; `teacher_spread`, the standard deviation of the teacher's
        own samples (sigma_E of docs/theory.md: guidance cannot move a teacher that is certain); the KL
        divergence of the executed actions from the teacher's in nats, mean and median over observations and
        executed steps.
    """
    generator = torch.Generator(device=decider.generator.device).manual_seed(seed)
    repeated, units = decider.reseeded(generator), decider.pair.alignment.teacher_units
    student = units(repeated.pair.student_actions(history)).cpu()  # (B, n, A)
    strengths = torch.full((len(student),), strength)
    alone, executed = [], []
    for _ in range(samples):
        noise = generator.get_state()
        alone.append(units(repeated.pair.teacher_actions(history, generator)).cpu())
        generator.set_state(noise)
        executed.append(units(repeated.decide(history, strengths).actions).cpu())
    of_teacher, of_strategy = torch.stack(alone), torch.stack(executed)  # (S, B, n, A)
    divergence = action_kl(of_strategy, of_teacher)
    return {
        "observations": len(student),
        "rms_to_student": _rms(of_strategy - student),
        "rms_to_teacher": _rms(of_strategy - of_teacher),
        "rms_teacher_to_student": _rms(of_teacher - student),
        "teacher_spread": float(of_teacher.var(dim=0).mean().sqrt()),
        "kl_to_teacher": float(divergence.mean()),
        "kl_to_teacher_median": float(np.median(divergence)),
    }


def action_kl(actions: Tensor, reference: Tensor) -> Array:
    """KL divergence of moment-matched Gaussians over single actions (Eq. 14), (B * n,) in nats.

    Args:
        actions: (S, B, n, A) samples, in the teacher's units.
        reference: samples of the teacher, of the same shape.
    """
    ours, theirs = (_per_action(samples) for samples in (actions, reference))
    return np.array([gaussian_kl(_blurred(p), _blurred(q)) for p, q in zip(ours, theirs, strict=True)])


def _per_action(samples: Tensor) -> Array:
    """(S, B, n, A) to (B * n, S, A)."""
    return samples.permute(1, 2, 0, 3).flatten(0, 1).double().numpy()


def _blurred(samples: Array) -> Gaussian:
    """Gaussian of samples (S, A) plus noise of standard deviation BLUR."""
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
    episodes: Iterable[Episode], stats: Statistics, config: DiagnosticsConfig, seed: int
) -> dict[str, Any] | None:
    """How diverse the low-dimensional states of episodes are, in the demonstrations' standard deviations.

    Args:
        episodes: the kept ones.
        stats: statistics of the demonstrations.
        config: how many states, which neighbour, which epsilon.
        seed: of the choice of states.

    Returns:
        `entropy`, from nearest neighbours, of at most `config.states` distinct states (`states`, `dim`), and
        `coverage`: the share of the next states in every second episode with a state of the other episodes
        within a root-mean-square epsilon (P_S of section 2, held out). None for what there are too few states for, and if
        observations are images only.
    """
    paths = [state_path(episode, stats) for episode in episodes]
    if not paths or paths[0].shape[1] == 0:
        return None
    rng = np.random.default_rng(seed)
    visited = _at_most(config.states, np.unique(np.concatenate(paths), axis=0), rng)
    entropy = knn_entropy(visited, config.neighbours) if len(visited) > config.neighbours else None
    return {
        "states": len(visited),
        "dim": visited.shape[1],
        "entropy": entropy,
        "coverage": _held_out_coverage(paths, config, rng),
    }


def state_path(episode: Episode, stats: Statistics) -> Array:
    """All vectors of an episode side by side, (T, D), standardised."""
    vectors = {key: value for key, value in episode.observations.items() if value.ndim == 2 and key in stats}
    floored = floor_statistics({key: stats[key] for key in vectors})
    columns = [
        standardize(vectors[key], floored[key]["mean"], floored[key]["std"]) for key in sorted(vectors)
    ]
    return np.concatenate(columns, axis=1) if columns else np.empty((len(episode), 0))


def _held_out_coverage(
    paths: Sequence[Array], config: DiagnosticsConfig, rng: np.random.Generator
) -> float | None:
    tested = [path[1:] for path in paths[1::2] if len(path) > 1]
    if not tested:
        return None
    test, train = (_at_most(config.states, np.concatenate(part), rng) for part in (tested, paths[::2]))
    return state_coverage(test, train, config.epsilon * math.sqrt(test.shape[1]))


def _at_most(n_states: int, states: Array, rng: np.random.Generator) -> Array:
    """A random choice of `n_states` rows, or all."""
    return states if len(states) <= n_states else states[rng.choice(len(states), n_states, replace=False)]
