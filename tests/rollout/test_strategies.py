"""The strategies against closed forms."""

import pytest
import torch
from hypothesis import given, settings, strategies as st
from toy_policies import (
    N_STEPS,
    STATE,
    TEACHER_UNIT,
    NoisyTeacher,
    Unguidable,
    histories,
    make_pair,
    noise,
    propose,
    student_actions,
)

from lerobot_agpd.agpd import GuidedStrategy, make_strategy
from lerobot_agpd.config import CollectConfig, GuidanceConfig, MixingConfig
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.rollout.strategies import (
    MixingStrategy,
    NearestStrategy,
    RollInStrategy,
    TeacherStrategy,
)

STRENGTHS = st.lists(st.floats(0, 1), min_size=5, max_size=5).map(torch.tensor)
SOME = torch.tensor([True, False, True, False, False])


def alone(history, seed=3):
    """The teacher's own executed steps under a seed."""
    return NoisyTeacher().sample(history, generator=noise(seed))[:, :N_STEPS]


def guided(pair=None, seed=3) -> GuidedStrategy:
    return GuidedStrategy(pair or make_pair(), noise(seed), GuidanceConfig(scale=1.0))


def mixed(form="interpolate", seed=3, **options) -> MixingStrategy:
    return MixingStrategy(make_pair(), noise(seed), MixingConfig(form=form, **options))


def rollin(seed=3) -> RollInStrategy:
    return RollInStrategy(guided(seed=seed))


def discrepancy_of(actions, history):
    gap = (actions - student_actions(history)) / TEACHER_UNIT
    return 0.5 * gap.square().sum(dim=(1, 2))


# ---- teacher and guided ----


def test_the_teacher_acts_alone_whatever_the_strength():
    history = histories()
    chunks = TeacherStrategy(make_pair(student=None), noise()).act(history, torch.ones(5))
    assert torch.equal(chunks.actions, alone(history))
    assert chunks.discrepancy.isnan().all() and chunks.guidance_shift.isnan().all()


@given(STRENGTHS)
@settings(max_examples=30)
def test_guidance_goes_the_fraction_that_its_scale_says(scale):
    """Scale s carries the toy teacher from its own chunk the fraction s of the way to the student's."""
    history = histories()
    chunks = guided().act(history, scale)
    expected = torch.lerp(alone(history), student_actions(history), scale[:, None, None])
    torch.testing.assert_close(chunks.actions, expected)
    torch.testing.assert_close(chunks.discrepancy, discrepancy_of(expected, history))
    shift = torch.where(scale > 0, scale, torch.nan)
    torch.testing.assert_close(chunks.guidance_shift, shift, equal_nan=True)
    assert torch.equal(chunks.actions[scale == 0], alone(history)[scale == 0])


def test_scale_zero_is_the_teacher_bit_for_bit_even_if_it_cannot_be_guided():
    history = histories()
    chunks = guided(make_pair(Unguidable())).act(history, torch.zeros(5))
    assert torch.equal(chunks.actions, alone(history))
    assert chunks.guidance_shift.isnan().all()
    torch.testing.assert_close(chunks.discrepancy, discrepancy_of(chunks.actions, history))


def test_both_see_the_longer_history():
    seen, history = [], histories(length=4)

    def watching(observed):
        seen.append(observed)
        return propose(observed)

    strategy = guided(make_pair(student=watching, student_n_obs_steps=4))
    assert strategy.n_obs_steps == 4 and guided().n_obs_steps == 2
    strategy.act(history, torch.ones(5))
    assert seen[0] is history


def test_another_discrepancy_guides():
    """A J whose target is twice the student's chunk."""
    made = []

    def make(pair, history, chunk_hat, action_j):
        made.append((history, chunk_hat))
        return type(action_j)(2 * action_j.target, action_j.start)

    history = histories()
    chunks = guided(make_pair(make_discrepancy=make)).act(history, torch.ones(5))
    torch.testing.assert_close(chunks.actions, 2 * student_actions(history))
    assert made[0][0] is history and torch.equal(made[0][1], propose(history))


# ---- mixing ----


@pytest.mark.parametrize("form", ["interpolate", "switch"])
def test_the_ends_of_lambda_are_teacher_and_student_bit_for_bit(form):
    history = histories()
    assert torch.equal(mixed(form).act(history, torch.zeros(5)).actions, alone(history))
    assert torch.equal(mixed(form).act(history, torch.ones(5)).actions, student_actions(history))


@given(STRENGTHS)
@settings(max_examples=30)
def test_interpolation_weighs_the_student_with_lambda(weight):
    """Eq. 6: lambda a_A + (1 - lambda) a_E."""
    history, w = histories(), weight[:, None, None]
    chunks = mixed().act(history, weight)
    expected = w * student_actions(history) + (1 - w) * alone(history)
    torch.testing.assert_close(chunks.actions, expected)
    torch.testing.assert_close(chunks.discrepancy, discrepancy_of(expected, history))
    assert chunks.guidance_shift.isnan().all() and chunks.recorded is None


def test_switch_executes_one_of_the_two_in_proportion():
    """Eq. 7: of 4000 decisions at lambda 0.3, 1200 +- 4 standard deviations (29) are the student's."""
    history = histories(n=4000)
    actions = mixed("switch").act(history, torch.full((4000,), 0.3)).actions
    of_student = (actions == student_actions(history)).all(dim=(1, 2))
    of_teacher = (actions == alone(history)).all(dim=(1, 2))
    assert (of_student ^ of_teacher).all()
    assert abs(int(of_student.sum()) - 1200) < 116


@pytest.mark.parametrize("form", ["interpolate", "switch"])
def test_the_teachers_action_can_be_recorded_in_place_of_the_executed_one(form):
    history = histories()
    chunks = mixed(form, record_teacher=True).act(history, torch.full((5,), 0.9))
    assert torch.equal(chunks.recorded, alone(history))
    assert not torch.equal(chunks.actions, chunks.recorded)


# ---- roll-in ----


def test_rollin_lets_each_act_in_its_part():
    history, scale = histories(), torch.tensor([1.0, 0.5, 0.5, 0.0, 1.0])
    strategy = rollin()
    chunks = strategy.act(history, scale, SOME)
    rest = {STATE: history[STATE][~SOME], "task": ["task 1", "task 3", "task 4"]}
    finishing = guided().act(rest, scale[~SOME])
    assert torch.equal(chunks.actions[SOME], student_actions(history)[SOME])
    assert torch.equal(chunks.actions[~SOME], finishing.actions)
    assert torch.equal(chunks.discrepancy[~SOME], finishing.discrepancy)
    assert chunks.discrepancy[SOME].isnan().all() and chunks.guidance_shift[SOME].isnan().all()
    assert strategy.pair.teacher.calls == [3]  # no chunk of the teacher is sampled that is not executed


def test_rollin_of_the_student_alone_and_of_the_teacher_alone():
    history = histories()
    strategy = rollin()
    everywhere = strategy.act(history, torch.ones(5), torch.ones(5, dtype=torch.bool))
    assert torch.equal(everywhere.actions, student_actions(history)) and strategy.pair.teacher.calls == []
    for nowhere in (None, torch.zeros(5, dtype=torch.bool)):
        chunks = rollin().act(history, torch.ones(5), nowhere)
        assert torch.equal(chunks.actions, guided().act(history, torch.ones(5)).actions)


# ---- all of them ----


@pytest.mark.parametrize("make", [guided, mixed, rollin])
def test_a_reseeded_copy_leaves_the_original_alone(make):
    history, strength = histories(), torch.full((5,), 0.5)
    untouched, original = make(seed=3), make(seed=3)
    first = original.reseeded(noise(9)).act(history, strength)
    assert torch.equal(first.actions, make(seed=9).act(history, strength).actions)
    assert original.stopwatch.seconds == {}
    assert torch.equal(original.act(history, strength).actions, untouched.act(history, strength).actions)


def test_time_of_teacher_and_student_is_taken_apart():
    strategy = mixed()
    strategy.act(histories(), torch.ones(5))
    assert set(strategy.stopwatch.seconds) == {"teacher", "student"}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("teacher", TeacherStrategy),
        ("guided", GuidedStrategy),
        ("mixing", MixingStrategy),
        ("rollin", RollInStrategy),
    ],
)
def test_strategies_by_name(agpd_config, name, kind):
    collect = CollectConfig(strategy=name, mixing=MixingConfig(form="switch"))
    strategy = make_strategy(agpd_config(collect=collect), make_pair(Unguidable()), noise())
    assert type(strategy) is kind
    strategy.act(histories(), torch.zeros(5), SOME)  # at strength 0 any teacher serves
    if name == "mixing":
        assert strategy.config is collect.mixing


@pytest.mark.parametrize("at", ["x0", "mu"])
def test_a_teacher_that_cannot_be_guided_is_refused(at):
    with pytest.raises(FlagError, match="--policy.collect.strategy.*'toy'"):
        Unguidable().require_guidance(at)
    NoisyTeacher().require_guidance(at)


# ---- nearest ----


def nearest(pair=None, seed=3) -> NearestStrategy:
    return NearestStrategy(pair or make_pair(Unguidable()), noise(seed))


def test_nearest_executes_a_sample_that_is_never_farther_than_the_teachers_own():
    history = histories()
    chunks = nearest().act(history, torch.full((5,), 32.0))
    own = discrepancy_of(alone(history), history)
    assert (chunks.discrepancy <= own).all() and (chunks.discrepancy < own).any()
    torch.testing.assert_close(chunks.discrepancy, discrepancy_of(chunks.actions, history))


def test_nearest_leaves_rows_without_strength_to_the_teacher_bit_for_bit():
    history = histories()
    chunks = nearest().act(history, torch.where(SOME, 16.0, 0.0))
    assert torch.equal(chunks.actions[~SOME], alone(history)[~SOME])
    assert not torch.equal(chunks.actions[SOME], alone(history)[SOME])
    assert torch.equal(nearest().act(history, torch.zeros(5)).actions, alone(history))


def test_nearest_samples_the_teacher_as_often_as_its_strength_says():
    teacher = Unguidable()
    nearest(make_pair(teacher)).act(histories(), torch.where(SOME, 4.0, 0.0))
    assert teacher.calls == [5, 2 * 3], "once for every row, three times more where it chooses"


def test_nearest_chooses_by_the_learned_discrepancy():
    """A J that is smallest for the largest first action: the choice is the largest of the samples."""
    start = NoisyTeacher.start
    pair = make_pair(Unguidable(), make_discrepancy=lambda *_: lambda chunk: -chunk[:, start, 0])
    history = histories()
    chosen = nearest(pair).act(history, torch.full((5,), 16.0)).actions[:, 0, 0]
    teacher, generator = Unguidable(), noise()
    first = teacher.sample(history, generator=generator)[:, 0, 0]
    repeated = {STATE: history[STATE].repeat_interleave(15, 0), "task": ["a task"] * 75}
    others = teacher.sample(repeated, generator=generator)[:, 0, 0].unflatten(0, (5, 15))
    torch.testing.assert_close(chosen, torch.maximum(first, others.max(dim=1).values))
