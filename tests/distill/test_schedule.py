import pytest

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.distill.schedule import due_round


def rounds(config, total_steps, last=None):
    """Update counts at which rounds are due, with the rounds' numbers."""
    due = {
        updates: due_round(updates, config, total_steps) for updates in range(1, (last or total_steps) + 1)
    }
    return {updates: number for updates, number in due.items() if number is not None}


def test_a_round_after_the_warmup_and_then_every_so_often():
    assert rounds(CollectConfig(warmup=5, every=10), 40) == {5: 0, 15: 1, 25: 2, 35: 3}


def test_no_round_at_the_last_step():
    assert rounds(CollectConfig(warmup=5, every=10), 25) == {5: 0, 15: 1}
    assert rounds(CollectConfig(warmup=5, every=10), 5) == {}


def test_unknown_length():
    assert rounds(CollectConfig(warmup=5, every=10), None, last=25) == {5: 0, 15: 1, 25: 2}


@pytest.mark.parametrize(
    ("n_rounds", "expected"), [(0, {}), (1, {5: 0}), (2, {5: 0, 15: 1}), (9, {5: 0, 15: 1, 25: 2})]
)
def test_number_of_rounds(n_rounds, expected):
    assert rounds(CollectConfig(warmup=5, every=10, rounds=n_rounds), 30) == expected


def test_collection_that_is_off():
    assert rounds(CollectConfig(warmup=5, every=0), 30) == {}


def test_every_step():
    assert rounds(CollectConfig(warmup=1, every=1), 4) == {1: 0, 2: 1, 3: 2}
