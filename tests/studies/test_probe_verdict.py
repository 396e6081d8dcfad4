"""What follows from measurements of a teacher."""

from dataclasses import replace

import pytest

from lerobot_agpd.studies.probe_verdict import Evidence, Pull, StateCount, conclude, fewer_steps

ALONE = Pull("teacher", 0, moved=0.0, chooses=0.35, off=0.04)
WEAK = Pull("guided", 0.3, moved=0.4, chooses=0.8, off=0.05)
ENOUGH = Pull("guided", 0.6, moved=0.8, chooses=0.95, off=0.06)
LOST = Pull("guided", 1.0, moved=0.9, chooses=1.0, off=0.5)
NEAREST = Pull("nearest", 16, moved=0.7, chooses=0.99, off=0.04)
SEVERAL = Evidence(
    spread=0.3,
    can_be_guided=True,
    starts=StateCount(20, 20),
    states=StateCount(3, 64),
    median_is_way=0.0,
    mean_is_way=0.0,
    pulls=[ALONE, WEAK, ENOUGH, LOST, NEAREST],
)
ONE = replace(
    SEVERAL, starts=StateCount(0, 20), states=StateCount(0, 64), median_is_way=None, mean_is_way=None
)
TEACHER_FLAGS = "--policy.collect.strategy=teacher"


def test_one_way_needs_no_guidance():
    verdict = conclude(ONE)
    assert verdict.finding == "one way" and verdict.flags == TEACHER_FLAGS
    assert "guidance will not help" in verdict.reasons[0]


def test_a_deterministic_teacher():
    verdict = conclude(replace(ONE, spread=0.0, can_be_guided=False))
    assert verdict.finding == "deterministic" and verdict.flags == TEACHER_FLAGS


def test_several_ways_whose_median_is_none_are_guided_by_the_weakest_pull_that_decides():
    verdict = conclude(SEVERAL)
    assert verdict.finding == "several ways"
    assert verdict.flags == (
        "--policy.collect.strategy=guided --policy.guidance.pull=0.6 --policy.guidance.max_pull=0.6"
    )
    assert "20 of 20 first states of episodes (100%)" in verdict.reasons[0]
    assert "3 of 64 states anywhere (5%)" in verdict.reasons[0]


def test_a_pull_may_grow_as_far_as_the_chunks_keep_to_the_ways():
    strong = replace(LOST, off=0.05)
    verdict = conclude(replace(SEVERAL, pulls=[ALONE, WEAK, ENOUGH, strong]))
    assert verdict.flags == "--policy.collect.strategy=guided --policy.guidance.pull=0.6"


def test_several_ways_whose_median_is_one():
    verdict = conclude(replace(SEVERAL, median_is_way=0.95))
    assert verdict.finding == "several ways, median a way"
    assert any("PD" in reason and "L1" in reason for reason in verdict.reasons)
    assert any("with L2, guide" in reason for reason in verdict.reasons)


@pytest.mark.parametrize(
    ("starts", "states", "finding"),
    [
        ((20, 20), (0, 64), "several ways"),  # the beginning alone decides
        ((0, 20), (10, 64), "several ways"),  # chosen on the way
        ((1, 20), (1, 64), "one way"),  # by chance: at least 1 of 64 in 73 % of the probes
        ((0, 20), (4, 64), "one way"),  # 3.9 %
        ((0, 20), (5, 64), "several ways"),  # 0.9 %
        ((2, 20), (0, 64), "one way"),  # 6.0 %
        ((3, 20), (0, 64), "several ways"),  # 0.7 %
    ],
)
def test_how_many_states_count(starts, states, finding):
    evidence = replace(SEVERAL, starts=StateCount(*starts), states=StateCount(*states))
    assert conclude(evidence).finding == finding


def test_a_teacher_that_cannot_be_guided_gets_nearest():
    evidence = replace(SEVERAL, can_be_guided=False, pulls=[ALONE, NEAREST])
    verdict = conclude(evidence)
    assert verdict.flags == "--policy.collect.strategy=nearest --policy.collect.nearest_samples=16"
    assert "cannot be guided" in verdict.reasons[-1]


@pytest.mark.parametrize(
    ("pulls", "flags"),
    [
        ([ALONE, WEAK, LOST, NEAREST], "nearest_samples=16"),  # guidance is too weak, or leaves the ways
        (
            [ALONE, WEAK, LOST],
            "guidance.pull=0.3 --policy.guidance.max_pull=0.3",
        ),  # the best that keeps to the ways
    ],
)
def test_guidance_that_does_not_decide_without_leaving_the_ways(pulls, flags):
    verdict = conclude(replace(SEVERAL, pulls=pulls))
    assert flags in verdict.flags
    assert ("None of those tried" in verdict.reasons[-1]) == (NEAREST not in pulls)


def test_fewer_steps():
    short = fewer_steps([(1, 0.3, 1.0), (2, 0.93, 2.0), (10, 0.95, 9.0)])
    assert "2 denoising steps" in short and "93%" in short and "9.0 ms" in short
    assert "do not replace" in fewer_steps([(1, 0.3, 1.0), (10, 0.95, 9.0)])
