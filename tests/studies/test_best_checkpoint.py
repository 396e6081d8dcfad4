"""The choice of the best checkpoint."""

from matrices import evaluation

from lerobot_agpd.studies.evaluation import Evaluation, best_step


def test_the_best_checkpoint_has_the_highest_measure_then_reward_then_step():
    curve = {10: evaluation([1, 0]), 20: evaluation([1, 1]), 30: evaluation([0, 0])}
    assert best_step(curve, "success") == 20
    better_reward = Evaluation([True, False], [0.6, 0.6], [0, 1])
    assert best_step({10: better_reward, 20: evaluation([1, 0])}, "success") == 10
    assert best_step({10: evaluation([1, 0]), 20: evaluation([0, 1])}, "success") == 20
    low_reward = Evaluation([True, True], [0.1, 0.1], [0, 1])
    assert best_step({10: better_reward, 20: low_reward}, "max_reward") == 10
