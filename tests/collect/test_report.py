import pytest

from lerobot_agpd.collect.report import success_rate, summarise, tally
from lerobot_agpd.replay.episode import EpisodeRecord

NAN = float("nan")


def record(
    scale=1.0, passed=True, trivial=False, length=10, reward=1.0, j=NAN, shift=NAN, **options
) -> EpisodeRecord:
    return EpisodeRecord(
        number=0,
        seed=1,
        scale=scale,
        length=length,
        max_reward=reward,
        success=None,
        passed=passed,
        trivial=trivial,
        kept=passed and not trivial,
        j=j,
        shift=shift,
        **options,
    )


RECORDS = [
    record(length=10, reward=0.5, j=2.0, shift=0.5),
    record(length=20, reward=1.5, j=4.0),
    record(passed=False, reward=0.0, j=NAN, shift=1.0),
    record(trivial=True, reward=1.0, j=6.0, shift=0.0),
    record(scale=0.0, length=30, reward=2.0, j=10.0),
    record(scale=0.0, passed=False, reward=1.0),
    record(scale=0.0, passed=False, trivial=True, reward=1.0),
]


def test_tally_by_hand():
    assert tally(RECORDS) == {"generated": 7, "trivial": 2, "successful": 3, "kept": 3}
    assert tally([]) == {"generated": 0, "trivial": 0, "successful": 0, "kept": 0}


def test_success_rate_by_hand():
    first, second = tally(RECORDS), tally(RECORDS[4:])
    assert success_rate([first]) == pytest.approx(3 / 5)
    assert success_rate([first, second]) == pytest.approx(4 / 7)  # pooled, not averaged
    assert success_rate([]) is None
    assert success_rate([tally([record(trivial=True)])]) is None


def test_summary_by_hand():
    summary = summarise(RECORDS)
    assert summary["guided"] == {"generated": 4, "trivial": 1, "successful": 2, "kept": 2}
    assert summary["unguided"] == {"generated": 3, "trivial": 1, "successful": 1, "kept": 1}
    assert summary["mean_max_reward"] == pytest.approx(7 / 7)
    assert summary["mean_j_guided"] == pytest.approx(4.0)  # NaN is left out
    assert summary["mean_j_unguided"] == 10.0
    assert summary["mean_shift_in_sigmas"] == pytest.approx(0.5)
    assert summary["kept_frames"] == 60
    assert len(summary["episodes"]) == 7 and summary["episodes"][2]["j"] is None
    assert summarise([])["mean_max_reward"] is None


def test_episodes_of_the_student_alone_are_counted_apart():
    alone = [
        record(student_alone=True, student_steps=10),
        record(scale=0.0, student_alone=True, passed=False),
    ]
    kept = record(student_steps=4), record(scale=0.0, student_steps=8)
    summary = summarise([*alone, *kept])
    assert summary["generated"] == 4
    assert summary["student_alone"] == {"generated": 2, "trivial": 0, "successful": 1, "kept": 1}
    assert summary["guided"]["generated"] == summary["unguided"]["generated"] == 1
    assert summary["mean_student_steps"] == 6.0  # where the teacher took over
    assert summarise(RECORDS)["student_alone"]["generated"] == 0


def test_failed_starts_that_are_tried_again_are_counted_apart():
    """They are harder: neither the strategy's nor the teacher's rate of success includes them."""
    again = [
        record(retry=True),
        record(retry=True, passed=False),
        record(scale=0.0, retry=True, passed=False),
    ]
    summary = summarise([*again, *RECORDS])
    assert summary["retried"] == {"generated": 3, "trivial": 0, "successful": 1, "kept": 1}
    assert summary["guided"] == summarise(RECORDS)["guided"]
    assert summary["unguided"] == summarise(RECORDS)["unguided"]
    assert summary["generated"] == 10 and summary["kept"] == 4
