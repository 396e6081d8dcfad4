import json
import logging
import math
from dataclasses import replace

import pytest

from lerobot_agpd.replay.episode import EpisodeRecord
from lerobot_agpd.rollout.diagnostics import RoundDiagnostics
from lerobot_agpd.rollout.report import RoundReport, Tally, log_round, round_scalars, success_rate


def record(
    strength=1.0, success=True, solved_at_start=False, length=10, max_reward=1.0, **options
) -> EpisodeRecord:
    kept = success and not solved_at_start
    facts = {"number": 0, "seed": 1, "is_success": None, "kept": kept, **options}
    facts |= {"strength": strength, "success": success, "solved_at_start": solved_at_start}
    return EpisodeRecord(length=length, max_reward=max_reward, **facts)


RECORDS = [
    record(length=10, max_reward=0.5, discrepancy=2.0, guidance_shift=0.5),
    record(length=20, max_reward=1.5, discrepancy=4.0),
    record(success=False, max_reward=0.0, guidance_shift=1.0),
    record(solved_at_start=True, discrepancy=6.0, guidance_shift=0.0),
    record(strength=0.0, length=30, max_reward=2.0, discrepancy=10.0),
    record(strength=0.0, success=False),
    record(strength=0.0, success=False, solved_at_start=True),
]


def report(records, **facts) -> RoundReport:
    return RoundReport.of(records, **{"round": 0, "strength": 1.0, "next_strength": 2.0, "step": 7, **facts})


def test_tally_by_hand():
    assert Tally.of(RECORDS) == Tally(generated=7, solved_at_start=2, successful=3, kept=3)
    assert Tally.of([]) == Tally(0, 0, 0, 0)


def test_success_rate_by_hand():
    first, second = Tally.of(RECORDS), Tally.of(RECORDS[4:])
    assert success_rate([first]) == pytest.approx(3 / 5)
    assert success_rate([first, second]) == pytest.approx(4 / 7)  # pooled, not averaged
    assert success_rate([]) is None
    assert success_rate([Tally.of([record(solved_at_start=True)])]) is None


def test_report_by_hand():
    made = report(RECORDS)
    assert made.strategy == Tally(generated=4, solved_at_start=1, successful=2, kept=2)
    assert made.teacher_only == Tally(generated=3, solved_at_start=1, successful=1, kept=1)
    assert made.mean_max_reward == pytest.approx(7 / 7)
    assert made.mean_discrepancy == pytest.approx(4.0)  # NaN is left out
    assert made.mean_discrepancy_teacher_only == 10.0
    assert made.mean_guidance_shift == pytest.approx(0.5)
    assert made.kept_frames == 60 and made.student_alone.generated == 0
    assert report([]).mean_max_reward is None


def test_episodes_of_the_student_alone_are_counted_apart():
    alone = [
        record(student_alone=True, student_steps=10),
        record(strength=0.0, student_alone=True, success=False),
    ]
    made = report([*alone, record(student_steps=4), record(strength=0.0, student_steps=8)])
    assert made.total.generated == 4
    assert made.student_alone == Tally(generated=2, solved_at_start=0, successful=1, kept=1)
    assert made.strategy.generated == made.teacher_only.generated == 1
    assert made.mean_student_steps == 6.0  # where the teacher took over


def test_failed_starts_that_are_tried_again_are_counted_apart():
    """They are harder: neither the strategy's nor the teacher's rate of success includes them."""
    again = [record(retry=True), record(retry=True, success=False)]
    made, without = (
        report([*again, record(strength=0.0, retry=True, success=False), *RECORDS]),
        report(RECORDS),
    )
    assert made.retried == Tally(generated=3, solved_at_start=0, successful=1, kept=1)
    assert (made.strategy, made.teacher_only) == (without.strategy, without.teacher_only)
    assert made.total.generated == 10 and made.total.kept == 4


def test_invalid_episodes_are_counted_apart():
    """Neither the strategy nor the teacher answers for what the environment delivers."""
    broken = [record(success=False, invalid="'next.reward' at step 3", max_reward=math.nan) for _ in range(2)]
    made = report([*broken, *RECORDS])
    assert made.total == Tally(generated=9, solved_at_start=2, successful=3, kept=3, invalid=2)
    assert made.strategy.invalid == 2
    assert success_rate([made.strategy]) == success_rate([report(RECORDS).strategy])
    assert made.mean_max_reward == report(RECORDS).mean_max_reward
    assert RoundReport.from_json(json.loads(json.dumps(made.to_json(), allow_nan=False))) == made


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["max_reward", "discrepancy", "guidance_shift"])
def test_a_record_with_an_unknown_number_is_json(name, value):
    made = record(
        success=False,
        invalid="'action' at step 0",
        **{"discrepancy": 0.0, "guidance_shift": 0.0, name: value},
    )
    restored = EpisodeRecord.from_json(json.loads(json.dumps(made.to_json(), allow_nan=False)))
    assert math.isnan(getattr(restored, name))
    assert replace(restored, **{name: 0.0}) == replace(made, **{name: 0.0})


def test_reports_and_records_survive_json():
    measured = RoundDiagnostics({"rms_to_student": 1.0}, {"entropy": None, "coverage": 0.5}, seconds=2.0)
    made = report(RECORDS, seconds={"teacher": 1.5}, diagnostics=measured)
    assert RoundReport.from_json(json.loads(json.dumps(made.to_json()))) == made
    entry = json.loads(json.dumps(RECORDS[2].to_json()))
    assert entry["discrepancy"] is None
    restored = EpisodeRecord.from_json(entry)
    assert math.isnan(restored.discrepancy)
    assert replace(restored, discrepancy=0.0) == replace(RECORDS[2], discrepancy=0.0)


def test_what_the_training_log_says():
    """The last round's rates and diagnostics, episodes summed over all rounds; what is unknown is left out."""
    assert round_scalars([]) == {"rounds": 0.0}
    measured = RoundDiagnostics({"rms_to_student": 1.0}, {"entropy": None, "coverage": 0.5}, seconds=2.0)
    last = report([record(discrepancy=3.0)], round=1, strength=0.25, diagnostics=measured)
    assert round_scalars([report(RECORDS), last]) == {
        "rounds": 2.0,
        "strength": 0.25,
        "strategy_success": 1.0,
        "mean_discrepancy": 3.0,
        "actions_rms_to_student": 1.0,
        "states_coverage": 0.5,
        "episodes_generated": 8.0,
        "episodes_successful": 4.0,
        "episodes_kept": 4.0,
    }


def test_a_round_without_a_kept_episode_is_warned_of(caplog):
    log_round(report(RECORDS))
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    log_round(report([record(success=False)]))
    assert "--policy.collect.min_reward" in caplog.text
