import pytest

from lerobot_agpd.collect.stopwatch import Stopwatch


def test_seconds_add_up_by_name():
    watch = Stopwatch({"teacher": 5.0})
    with watch.measure("teacher"), watch.measure("student"):
        pass
    assert watch.seconds["teacher"] > 5.0 and watch.seconds["student"] > 0


def test_what_failed_has_taken_its_time_too():
    watch = Stopwatch()
    with pytest.raises(KeyError), watch.measure("teacher"):
        raise KeyError
    assert watch.seconds["teacher"] > 0
