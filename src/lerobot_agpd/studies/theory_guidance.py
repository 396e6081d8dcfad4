"""Guidance against action mixing at one observation: Eq. 6-16 of the paper, as printed and with the slips repaired.

Teacher ("expert") and student are isotropic Gaussians over actions, N(mu_E, var_teacher I) and N(mu_A, var_student I),
and only the distance between their means matters. If guidance and mixing spread the actions equally, which one
stays closer to the teacher? Guidance tilts the student (Eq. 9) or the teacher (Eq. 20, what the algorithm does);
mixing interpolates two actions (Eq. 6) or picks one of them (Eq. 7). So there are four cases. `docs/theory.md`
tells what comes out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np


class Tilt(StrEnum):
    """Which policy guidance starts from; it is pulled toward the other one's mean."""

    STUDENT = "student"  # Eq. 9: the student, tilted by closeness to the teacher
    TEACHER = "teacher"  # Eq. 20: the teacher, tilted toward the student (the algorithm)


class Mixing(StrEnum):
    """What action mixing does with an action of either policy."""

    INTERPOLATE = "interpolate"  # Eq. 6: lambda a_A + (1 - lambda) a_E, independent draws
    SWITCH = "switch"  # Eq. 7: a_A with probability lambda, else a_E


@dataclass(frozen=True)
class Policies:
    """Teacher and student at one observation.

    Attributes:
        var_teacher: sigma_E^2, positive.
        var_student: sigma_A^2; 0 is a deterministic student.
        gap: ||mu_A - mu_E||.
        dim: dimension of the action.
    """

    var_teacher: float
    var_student: float
    gap: float
    dim: int = 1

    def __post_init__(self) -> None:
        if self.var_teacher <= 0 or self.var_student < 0 or self.gap < 0 or self.dim < 1:
            raise ValueError(f"need var_teacher > 0, var_student >= 0, gap >= 0 and dim >= 1, got {self}")


@dataclass(frozen=True)
class ActionLaw:
    """First two moments of the executed action; fields may be arrays of one shape.

    Attributes:
        fraction: how far the mean went from the teacher's (0) to the student's (1).
        var_along: variance along the line that joins the two means.
        var_across: variance along each of the dim - 1 axes across it.
        dim: dimension of the action.
    """

    fraction: float
    var_along: float
    var_across: float
    dim: int

    @property
    def variance(self) -> float:
        """Mean variance per axis: the trace over dim, what "diversity" means here."""
        return (self.var_along + (self.dim - 1) * self.var_across) / self.dim


def mix(policies: Policies, lam: float, mixing: Mixing, printed: bool = False) -> ActionLaw:
    """Moments of action mixing with weight `lam` on the student (Eq. 6 or Eq. 7-8).

    Args:
        policies: teacher and student.
        lam: lambda in [0, 1].
        mixing: interpolation or random choice.
        printed: Eq. 13 puts ||mu_A - mu_E||^2 I in the place of the outer product in Eq. 8. In one dimension that
            is the same; in more it counts the gap once per axis.
    """
    if np.any(np.asarray(lam) < 0) or np.any(np.asarray(lam) > 1):
        raise ValueError(f"lambda must lie in [0, 1], got {lam}")
    if mixing is Mixing.INTERPOLATE:
        var = lam**2 * policies.var_student + (1 - lam) ** 2 * policies.var_teacher
        return ActionLaw(lam, var, var, policies.dim)
    var = lam * policies.var_student + (1 - lam) * policies.var_teacher
    var_along = var + lam * (1 - lam) * policies.gap**2
    return ActionLaw(lam, var_along, var_along if printed else var, policies.dim)


def guide(policies: Policies, k: float, tilt: Tilt) -> ActionLaw:
    """Moments of a Gaussian tilted by exp(-k/2 ||a - target||^2), target the other policy's mean (B.3, Eq. 16).

    Precisions add: the variance shrinks by 1 / (1 + k var) and the mean keeps that fraction of its distance to the
    target. A target that is itself drawn, as in section 3.1, adds variance; B.3 replaces it by its mean.

    Raises:
        ValueError: for k < 0.
    """
    if np.any(np.asarray(k) < 0):
        raise ValueError(f"guidance strength k must be at least 0, got {k}")
    start_var = policies.var_student if tilt is Tilt.STUDENT else policies.var_teacher
    kept = 1 / (1 + k * start_var)
    fraction = kept if tilt is Tilt.STUDENT else 1 - kept
    return ActionLaw(fraction, start_var * kept, start_var * kept, policies.dim)


def fraction_at_equal_variance(
    policies: Policies, lam: float, tilt: Tilt, mixing: Mixing, printed: bool = False
) -> float:
    """How far guidance moves the mean when it spreads actions as much as mixing with `lam` does (Theorem 3.3).

    Eq. 15 says that this is below `lam`. Values outside [0, 1] mean that no k >= 0 reaches mixing's variance.

    Raises:
        ValueError: for Tilt.STUDENT with a deterministic student, which nothing can tilt.
    """
    if tilt is Tilt.STUDENT and policies.var_student == 0:
        raise ValueError("Eq. 9 tilts the student: var_student must be positive, got 0")
    variance = mix(policies, lam, mixing, printed).variance
    return variance / policies.var_student if tilt is Tilt.STUDENT else 1 - variance / policies.var_teacher


def k_of_lambda(policies: Policies, lam: float, tilt: Tilt, mixing: Mixing, printed: bool = False) -> float:
    """The guidance strength k whose variance equals mixing's (Theorem 3.3; Eq. 13 is Eq. 9 with Eq. 7, printed).

    Returns inf where mixing leaves no variance at all.

    Raises:
        ValueError: where no k >= 0 does.
    """
    fraction = fraction_at_equal_variance(policies, lam, tilt, mixing, printed)
    if not 0 <= fraction <= 1:
        raise ValueError(
            f"no k >= 0 gives {tilt} guidance the variance that mixing ({mixing}) has at lambda = {lam}: "
            f"mixing {mix(policies, lam, mixing, printed).variance:.4g}, guidance at most "
            f"{policies.var_student if tilt is Tilt.STUDENT else policies.var_teacher:.4g}"
        )
    if tilt is Tilt.STUDENT:
        return (1 - fraction) / (fraction * policies.var_student)
    return fraction / ((1 - fraction) * policies.var_teacher) if fraction < 1 else math.inf


def kl_to_teacher(policies: Policies, law: ActionLaw) -> float:
    """KL(executed || teacher) between Gaussians of these moments, in nats (Eq. 14).

    Random choice (Eq. 7) is not Gaussian: its own KL is larger by its negentropy, and infinite if the student is
    deterministic.
    """
    ratios = [
        (law.var_along / policies.var_teacher, 1),
        (law.var_across / policies.var_teacher, policies.dim - 1),
    ]
    with np.errstate(divide="ignore"):
        spread = sum(axes * (ratio - 1 - np.log(ratio)) for ratio, axes in ratios if axes)
    return 0.5 * (spread + law.fraction**2 * policies.gap**2 / policies.var_teacher)


@dataclass(frozen=True)
class Comparison:
    """Guidance and mixing with equal mean variance per axis (section 3.4)."""

    k: float
    guided: ActionLaw
    mixed: ActionLaw
    kl_guided: float
    kl_mixed: float


def compare(policies: Policies, lam: float, tilt: Tilt, mixing: Mixing, printed: bool = False) -> Comparison:
    """Solve Theorem 3.3 for k, then compare both methods' distance to the teacher (Eq. 14-15).

    Raises:
        ValueError: where the two cannot be made equally diverse.
    """
    k = k_of_lambda(policies, lam, tilt, mixing, printed)
    guided, mixed = guide(policies, k, tilt), mix(policies, lam, mixing, printed)
    return Comparison(k, guided, mixed, kl_to_teacher(policies, guided), kl_to_teacher(policies, mixed))
