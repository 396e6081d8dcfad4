"""The strategies against closed forms."""

import pytest
import torch
from hypothesis import given, settings, strategies as st
from toy_policies import (
    N_STEPS,
    STATE,
    TEACHER_UNIT,
    NoisyTeacher,
    Replayer,
    histories,
    make_pair,
    noise,
    propose,
    student_actions,
)

from lerobot_agpd.collect.config import MixingConfig
from lerobot_agpd.collect.deciders.mixing import MixedPolicies
from lerobot_agpd.collect.deciders.rollin import RollIn
from lerobot_agpd.collect.deciders.teacher import GuidedTeacher, TeacherAlone
from lerobot_agpd.guidance.config import GuidanceConfig


def alone(history, seed=3, teacher=None):
    """The teacher's own executed steps under a seed."""
    return (teacher or NoisyTeacher()).sample(history, generator=noise(seed))[:, :N_STEPS]


def guided(pair=None, quantile=0.0, seed=3) -> GuidedTeacher:
    return GuidedTeacher(pair or make_pair(), noise(seed), GuidanceConfig(), quantile)


def j_of(actions, history):
    gap = (actions - student_actions(history)) / TEACHER_UNIT
    return 0.5 * gap.square().sum(dim=(1, 2))


# ---- replay and guided ----


def test_teacher_alone():
    history = histories()
    decision = TeacherAlone(make_pair(student=None), noise()).decide(history, torch.ones(5))
    assert torch.equal(decision.actions, alone(history))
    assert decision.j.isnan().all() and decision.shift.isnan().all() and decision.recorded is None


@given(st.lists(st.floats(0, 1), min_size=5, max_size=5))
@settings(max_examples=30)
def test_property_guidance_goes_the_share_it_is_told(scales):
    """Scale s carries the toy teacher from its own chunk the share s of the way to the student's."""
    history, scale = histories(), torch.tensor(scales)
    decision = guided().decide(history, scale)
    expected = torch.lerp(alone(history), student_actions(history), scale[:, None, None])
    torch.testing.assert_close(decision.actions, expected)
    torch.testing.assert_close(decision.j, j_of(expected, history))
    torch.testing.assert_close(decision.shift, torch.where(scale > 0, scale, torch.nan), equal_nan=True)


def test_scale_zero_is_the_teacher_bit_for_bit_even_if_it_cannot_be_guided():
    history = histories()
    decision = guided(make_pair(Replayer())).decide(history, torch.zeros(5))
    assert torch.equal(decision.actions, alone(history))
    assert decision.shift.isnan().all()
    torch.testing.assert_close(decision.j, j_of(decision.actions, history))


def test_history_is_the_longer_of_both():
    assert make_pair(student_n_obs_steps=1).n_obs_steps == 2
    assert guided(make_pair(student_n_obs_steps=4)).n_obs_steps == 4


def test_both_see_the_whole_history():
    seen = []

    def watching(history):
        seen.append(history)
        return propose(history)

    history = histories(length=4)
    guided(make_pair(student=watching, student_n_obs_steps=4)).decide(history, torch.ones(5))
    assert seen[0] is history


def test_given_discrepancy_guides():
    """A J whose target is twice the student's chunk."""
    made = []

    def make(history, chunk_hat, action_j):
        made.append((history, chunk_hat))
        return type(action_j)(2 * action_j.target, action_j.start)

    history = histories()
    decision = guided(make_pair(make_discrepancy=make)).decide(history, torch.ones(5))
    torch.testing.assert_close(decision.actions, 2 * student_actions(history))
    assert made[0][0] is history and torch.equal(made[0][1], propose(history))


def test_quantile_guides_where_they_disagree():
    """Median of one batch of five: the two rows with the largest J of the unguided chunk are guided."""
    history = histories()
    own, student = alone(history), student_actions(history)
    far = j_of(own, history) > j_of(own, history).median()
    decision = guided(quantile=0.5).decide(history, torch.ones(5))
    assert far.sum() == 2
    torch.testing.assert_close(decision.actions[far], student[far])
    assert torch.equal(decision.actions[~far], own[~far])
    assert torch.equal(decision.shift.isnan(), ~far)


def test_quantile_runs_over_all_decisions_so_far():
    decider, history = guided(make_pair(NoisyTeacher(spread=0.0)), quantile=0.5), histories()
    decider.decide(history, torch.ones(5))
    j = j_of(alone(history, teacher=NoisyTeacher(spread=0.0)), history)
    lowest = {
        key: value[j.argmin()].unsqueeze(0) if isinstance(value, torch.Tensor) else value[:1]
        for key, value in history.items()
    }
    assert decider.decide(lowest, torch.ones(1)).shift.isnan().all()  # its own J is the smallest of six


def test_quantile_takes_the_same_noise_as_plain_guidance():
    history = histories()
    plain, picky = guided(), guided(quantile=1e-9)
    for _ in range(2):
        ours, theirs = plain.decide(history, torch.ones(5)), picky.decide(history, torch.ones(5))
        picked = ~theirs.shift.isnan()
        assert picked.sum() >= 4  # all but at most the smallest
        assert torch.equal(ours.actions[picked], theirs.actions[picked])


# ---- mixing ----


def mixed(form="interpolate", seed=3, **options) -> MixedPolicies:
    return MixedPolicies(make_pair(), noise(seed), MixingConfig(form=form, **options))


@pytest.mark.parametrize("form", ["interpolate", "switch"])
def test_the_ends_of_lambda_are_teacher_and_student_bit_for_bit(form):
    history = histories()
    assert torch.equal(mixed(form).decide(history, torch.zeros(5)).actions, alone(history))
    assert torch.equal(mixed(form).decide(history, torch.ones(5)).actions, student_actions(history))


@given(st.lists(st.floats(0, 1), min_size=5, max_size=5))
@settings(max_examples=30)
def test_property_interpolation_weighs_the_student_with_lambda(weights):
    """Eq. 6: lambda a_A + (1 - lambda) a_E."""
    history, weight = histories(), torch.tensor(weights)
    decision = mixed().decide(history, weight)
    w = weight[:, None, None]
    expected = w * student_actions(history) + (1 - w) * alone(history)
    torch.testing.assert_close(decision.actions, expected)
    torch.testing.assert_close(decision.j, j_of(expected, history))
    assert decision.shift.isnan().all() and decision.recorded is None


def test_switch_executes_one_of_the_two_in_proportion():
    """Eq. 7: of 4000 decisions at lambda 0.3, 1200 +- 4 standard deviations (29) are the student's."""
    history = histories(n=4000)
    actions = mixed("switch").decide(history, torch.full((4000,), 0.3)).actions
    of_student = (actions == student_actions(history)).all(dim=(1, 2))
    of_teacher = (actions == alone(history)).all(dim=(1, 2))
    assert (of_student ^ of_teacher).all()
    assert abs(int(of_student.sum()) - 1200) < 116


@pytest.mark.parametrize("form", ["interpolate", "switch"])
def test_relabel_records_the_teacher(form):
    history = histories()
    decision = mixed(form, relabel=True).decide(history, torch.full((5,), 0.9))
    assert torch.equal(decision.recorded, alone(history))
    assert not torch.equal(decision.actions, decision.recorded)


# ---- roll-in ----


def rollin(seed=3) -> RollIn:
    pair = make_pair()
    return RollIn(pair, guided(pair, seed=seed))


def test_rollin_lets_each_act_in_its_part():
    history, rolling_in = histories(), torch.tensor([True, False, True, False, False])
    scale = torch.tensor([1.0, 0.5, 0.5, 0.0, 1.0])
    decider = rollin()
    decision = decider.decide(history, scale, rolling_in)
    rest = {STATE: history[STATE][~rolling_in], "task": ["task 1", "task 3", "task 4"]}
    finishing = guided().decide(rest, scale[~rolling_in])
    assert torch.equal(decision.actions[rolling_in], student_actions(history)[rolling_in])
    assert torch.equal(decision.actions[~rolling_in], finishing.actions)
    assert torch.equal(decision.j[~rolling_in], finishing.j)
    assert decision.j[rolling_in].isnan().all() and decision.shift[rolling_in].isnan().all()
    assert decider.pair.teacher.calls == [3]  # no chunk of the teacher is sampled that nobody executes


def test_rollin_of_the_student_alone_and_of_nobody():
    history = histories()
    decider = rollin()
    everybody = decider.decide(history, torch.ones(5), torch.ones(5, dtype=torch.bool))
    assert torch.equal(everybody.actions, student_actions(history)) and decider.pair.teacher.calls == []
    for nobody in (None, torch.zeros(5, dtype=torch.bool)):
        decision = rollin().decide(history, torch.ones(5), nobody)
        assert torch.equal(decision.actions, guided().decide(history, torch.ones(5)).actions)


# ---- all of them ----


@pytest.mark.parametrize("make", [guided, mixed, rollin, lambda seed: guided(quantile=0.5, seed=seed)])
def test_reseeded_copy_leaves_the_original_alone(make):
    history, weight = histories(), torch.full((5,), 0.5)
    untouched, original = make(seed=3), make(seed=3)
    copy = original.reseeded(noise(9))
    first = copy.decide(history, weight)
    assert torch.equal(first.actions, make(seed=9).decide(history, weight).actions)
    assert original.stopwatch.seconds == {}
    assert torch.equal(original.decide(history, weight).actions, untouched.decide(history, weight).actions)


def test_time_of_teacher_and_student_is_taken_apart():
    decider = mixed()
    decider.decide(histories(), torch.ones(5))
    assert set(decider.stopwatch.seconds) == {"teacher", "student"}
