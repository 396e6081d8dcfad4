"""Checkpoints evaluated in environments that are built once."""

from contextlib import closing

import pytest
from lerobot.envs.configs import PushtEnv

from lerobot_agpd.studies.evaluation import Evaluator


def test_environments_serve_every_evaluation_as_if_new(student, tmp_path):
    pytest.importorskip("gym_pusht")
    config = PushtEnv(obs_type="environment_state_agent_pos", episode_length=12)
    with closing(Evaluator(config, 2, tmp_path / "a", "cpu")) as evaluator:
        evaluator.evaluate(student, 2, 500_000)
        environments = evaluator.environments
        after_another = evaluator.evaluate(student, 3, 100_000)
        assert evaluator.environments is environments
    with closing(Evaluator(config, 2, tmp_path / "b", "cpu")) as evaluator:
        alone = evaluator.evaluate(student, 3, 100_000)
    assert alone == after_another
    assert alone.seeds == [100_000, 100_001, 100_002] and len(set(alone.max_rewards)) > 1
