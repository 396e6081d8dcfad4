"""Guidance against mixing (Eq. 6-16): Monte Carlo, quadrature, hand-computed values and counterexamples."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from lerobot_agpd.rollout.diversity import Gaussian, gaussian_kl
from lerobot_agpd.studies.theory_guidance import (
    ActionLaw,
    Mixing,
    Policies,
    Tilt,
    compare,
    fraction_at_equal_variance,
    guide,
    k_of_lambda,
    kl_to_teacher,
    mix,
)

SWITCH, INTERPOLATE = Mixing.SWITCH, Mixing.INTERPOLATE
positive = st.floats(0.05, 5.0)
lambdas = st.floats(0.02, 0.98)


def policies(min_student: float = 0.0):
    return st.builds(
        Policies,
        positive,
        st.floats(min_student, 5.0),
        st.floats(0.0, 3.0),
        st.integers(min_value=1, max_value=6),
    )


# Moments: Eq. 6-9, 16


def sampled_moments(actions: np.ndarray, toward: np.ndarray) -> ActionLaw:
    """Moments of actions (N, 3) whose means lie on the line through 0 (teacher) and `toward` (student)."""
    gap = np.linalg.norm(toward)
    along = actions @ toward / gap
    total = actions.var(axis=0).sum()
    return ActionLaw(along.mean() / gap, along.var(), (total - along.var()) / 2, 3)


@pytest.mark.parametrize("mixing", list(Mixing))
def test_mixing_has_the_moments_of_samples(mixing):
    rng = np.random.default_rng(3)
    toward = np.array([1.0, -2.0, 0.5])
    p = Policies(0.5, 1.5, float(np.linalg.norm(toward)), 3)
    n, lam = 400_000, 0.3
    teacher = math.sqrt(0.5) * rng.normal(size=(n, 3))
    student = toward + math.sqrt(1.5) * rng.normal(size=(n, 3))
    if mixing is INTERPOLATE:
        actions = lam * student + (1 - lam) * teacher
    else:
        actions = np.where(rng.random((n, 1)) < lam, student, teacher)
    found, law = sampled_moments(actions, toward), mix(p, lam, mixing)
    for field in ("fraction", "var_along", "var_across", "variance"):
        assert getattr(law, field) == pytest.approx(getattr(found, field), rel=0.01), field


def test_eq_13_counts_the_gap_once_per_axis():
    p = Policies(1.0, 1.0, 2.0, dim=4)
    assert mix(p, 0.5, SWITCH).variance == 1 + 0.25 * 4 / 4
    assert mix(p, 0.5, SWITCH, printed=True).variance == 1 + 0.25 * 4


@pytest.mark.parametrize("tilt", list(Tilt))
@pytest.mark.parametrize("k", [0.0, 0.4, 3.0])
def test_guidance_is_the_exact_tilt(tilt, k):
    p = Policies(0.6, 1.7, 1.3)  # teacher at 0, student at 1.3
    start = norm(0, math.sqrt(0.6)) if tilt is Tilt.TEACHER else norm(1.3, math.sqrt(1.7))
    target = 1.3 if tilt is Tilt.TEACHER else 0.0

    def moment(power: int) -> float:
        return quad(lambda a: a**power * start.pdf(a) * math.exp(-k / 2 * (a - target) ** 2), -15, 15)[0]

    mean = moment(1) / moment(0)
    law = guide(p, k, tilt)
    assert law.fraction * p.gap == pytest.approx(mean, abs=1e-6)
    assert law.variance == pytest.approx(moment(2) / moment(0) - mean**2, rel=1e-6)


def test_divergence_is_eq_14_with_matrices():
    p = Policies(0.6, 0.2, 1.5, dim=3)
    law = mix(p, 0.4, SWITCH)
    executed = Gaussian(np.array([0.4 * 1.5, 0, 0]), np.diag([law.var_along, law.var_across, law.var_across]))
    assert kl_to_teacher(p, law) == pytest.approx(
        gaussian_kl(executed, Gaussian(np.zeros(3), 0.6 * np.eye(3)))
    )
    assert kl_to_teacher(p, guide(p, 0.0, Tilt.TEACHER)) == 0


# Theorem 3.3


def test_eq_13_by_hand_and_the_counterexample_to_eq_15():
    p = Policies(var_teacher=1.0, var_student=4.0, gap=1.0, dim=2)
    k = k_of_lambda(p, 0.5, Tilt.STUDENT, SWITCH, printed=True)
    assert 4 / (1 + k * 4) == pytest.approx(0.5 * 4 + 0.5 * 1 + 0.25 * 1)  # Eq. 13
    found = compare(p, 0.5, Tilt.STUDENT, SWITCH, printed=True)
    assert found.guided.fraction == pytest.approx(2.75 / 4)  # W = 0.6875 > lambda
    assert found.guided.fraction > found.mixed.fraction and found.kl_guided > found.kl_mixed


@given(policies(0.05), lambdas, st.sampled_from(Tilt), st.sampled_from(Mixing))
@settings(deadline=None)
def test_k_of_lambda_spreads_actions_as_much_as_mixing(p, lam, tilt, mixing):
    assume(0 <= fraction_at_equal_variance(p, lam, tilt, mixing) <= 1)
    k = k_of_lambda(p, lam, tilt, mixing)
    assert guide(p, k, tilt).variance == pytest.approx(mix(p, lam, mixing).variance)


def test_a_student_as_noisy_as_the_teacher_cannot_be_matched():
    """The very values that B.4 calls typical: sigma_A = sigma_E with a moderate gap."""
    for tilt in Tilt:
        with pytest.raises(ValueError, match="no k >= 0"):
            k_of_lambda(Policies(1.0, 1.0, 0.5), 0.3, tilt, SWITCH)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Policies(0.0, 1.0, 1.0), "var_teacher > 0"),
        (lambda: mix(Policies(1, 1, 1), 1.2, SWITCH), r"lambda must lie in \[0, 1\]"),
        (lambda: guide(Policies(1, 1, 1), -1.0, Tilt.TEACHER), "at least 0"),
        (lambda: k_of_lambda(Policies(1, 0, 1), 0.5, Tilt.STUDENT, SWITCH), "var_student must be positive"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# Eq. 15 in the four cases


@given(policies(0.05), lambdas, st.booleans())
@settings(deadline=None)
def test_tilted_student_against_random_choice_is_always_farther(p, lam, printed):
    assert fraction_at_equal_variance(p, lam, Tilt.STUDENT, SWITCH, printed) > lam


@given(policies(), lambdas, st.booleans())
@settings(deadline=None)
def test_tilted_teacher_against_random_choice_is_never_farther(p, lam, printed):
    fraction = fraction_at_equal_variance(p, lam, Tilt.TEACHER, SWITCH, printed)
    assert fraction <= lam + 1e-12
    if p.var_student > 0.01:
        assert fraction < lam
    if fraction >= 0:
        found = compare(p, lam, Tilt.TEACHER, SWITCH, printed)
        assert found.kl_guided <= found.kl_mixed + 1e-12


@given(policies(0.05), lambdas, st.sampled_from(Tilt))
@settings(deadline=None)
def test_against_interpolation_it_depends_on_lambda(p, lam, tilt):
    threshold = p.var_teacher / (p.var_teacher + p.var_student)
    assume(abs(lam - threshold) > 1e-6)
    assert (fraction_at_equal_variance(p, lam, tilt, INTERPOLATE) < lam) == (lam > threshold)


@given(positive, st.floats(0.1, 3.0), lambdas)
@settings(deadline=None)
def test_a_deterministic_student_is_farther_than_interpolation(var_teacher, gap, lam):
    found = compare(Policies(var_teacher, 0.0, gap), lam, Tilt.TEACHER, INTERPOLATE)
    assert found.guided.fraction == pytest.approx(lam * (2 - lam))
    assert found.guided.fraction > found.mixed.fraction and found.kl_guided >= found.kl_mixed


@given(policies(0.05), lambdas)
@settings(deadline=None)
def test_at_most_one_tilt_can_match_random_choice(p, lam):
    assume(p.gap > 0.01)
    fractions = [fraction_at_equal_variance(p, lam, tilt, SWITCH) for tilt in Tilt]
    assert sum(fraction <= 1 and fraction >= 0 for fraction in fractions) <= 1


def test_the_true_mixture_is_even_farther_from_the_teacher():
    p, lam = Policies(1.0, 0.2, 0.8), 0.5
    found = compare(p, lam, Tilt.TEACHER, SWITCH)
    teacher, student = norm(0, 1), norm(0.8, math.sqrt(0.2))

    def integrand(a: float) -> float:
        density = lam * student.pdf(a) + (1 - lam) * teacher.pdf(a)
        return density * math.log(density / teacher.pdf(a))

    assert found.kl_guided < found.kl_mixed < quad(integrand, -8, 8)[0]


# What guidance does to diversity


@given(policies(), st.floats(0.01, 20))
@settings(deadline=None)
def test_guiding_the_teacher_shrinks_its_variance(p, k):
    assert guide(p, k, Tilt.TEACHER).variance < p.var_teacher


@given(policies(), lambdas)
@settings(deadline=None)
def test_at_equal_pull_guidance_spreads_more_than_interpolation_below_the_threshold(p, lam):
    threshold = p.var_teacher / (p.var_teacher + p.var_student)
    assume(abs(lam - threshold) > 1e-6)
    guided = guide(p, lam / ((1 - lam) * p.var_teacher), Tilt.TEACHER)
    assert guided.fraction == pytest.approx(lam)
    assert (guided.variance > mix(p, lam, INTERPOLATE).variance) == (lam < threshold)


def test_random_choice_can_widen_the_teachers_actions():
    far = mix(Policies(1.0, 0.0, 2.0), 0.3, SWITCH)
    assert far.variance == pytest.approx(0.7 + 0.21 * 4)  # 1.54: a deterministic student two sigmas away
    assert mix(Policies(1.0, 0.0, 2.0), 0.3, INTERPOLATE).variance == pytest.approx(0.49)
