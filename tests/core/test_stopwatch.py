import pytest

from lerobot_agpd.stopwatch import Stopwatch


def test_seconds_add_up_by_name_after_a_failure_too():
    watch = Stopwatch({"teacher": 5.0})
    with pytest.raises(KeyError), watch.measure("teacher"), watch.measure("student"):
        raise KeyError
    assert watch.seconds["teacher"] > 5.0 and watch.seconds["student"] > 0
