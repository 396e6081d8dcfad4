"""Evaluations on disk, and the choice of the best checkpoint."""

import json

import pytest
from matrices import evaluation

from lerobot_agpd.studies.evaluation import Evaluation, best_step, read_evaluation, store_evaluation

REQUEST = {"seed": 100_000, "episodes": 3, "weights": "a"}


def test_an_evaluation_is_reused_for_the_same_request(tmp_path):
    store_evaluation(tmp_path, REQUEST, evaluation([1, 0, 1]))
    store_evaluation(tmp_path, {**REQUEST, "weights": "b"}, evaluation([0, 0, 0]))
    assert read_evaluation(tmp_path, REQUEST) == evaluation([1, 0, 1])
    assert read_evaluation(tmp_path, {**REQUEST, "weights": "c"}) is None


@pytest.mark.parametrize("damage", ["missing episodes", "half a file", "no rewards"])
def test_a_damaged_evaluation_is_not_reused(tmp_path, damage):
    file = store_evaluation(
        tmp_path, REQUEST, evaluation([1, 0] if damage == "missing episodes" else [1, 0, 1])
    )
    if damage == "half a file":
        file.write_text(file.read_text()[:50])
    if damage == "no rewards":
        content = json.loads(file.read_text())
        del content["max_rewards"]
        file.write_text(json.dumps(content))
    assert read_evaluation(tmp_path, REQUEST) is None


def test_the_best_checkpoint_has_the_highest_measure_then_reward_then_step():
    curve = {10: evaluation([1, 0]), 20: evaluation([1, 1]), 30: evaluation([0, 0])}
    assert best_step(curve, "success") == 20
    better_reward = Evaluation([True, False], [0.6, 0.6], [0, 1])
    assert best_step({10: better_reward, 20: evaluation([1, 0])}, "success") == 10
    assert best_step({10: evaluation([1, 0]), 20: evaluation([0, 1])}, "success") == 20
    low_reward = Evaluation([True, True], [0.1, 0.1], [0, 1])
    assert best_step({10: better_reward, 20: low_reward}, "max_reward") == 10
