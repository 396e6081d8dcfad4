"""Checkpoints evaluated in environments that are built once."""

import pytest
from lerobot.envs.configs import PushtEnv
from lerobot.utils.random_utils import seeded_context

from lerobot_agpd.studies.evaluation import Checkpoint, Environments


def test_environments_serve_every_evaluation_as_if_new(student):
    pytest.importorskip("gym_pusht")
    config = PushtEnv(obs_type="environment_state_agent_pos", episode_length=12)

    def evaluate(environments, episodes, seed):
        with seeded_context(0):
            return Checkpoint(student, "cpu").evaluate(environments, episodes, seed)

    with Environments(config, n_envs=2) as environments:
        first = evaluate(environments, 3, 100_000)
        vectors = environments.vectors
        evaluate(environments, 2, 500_000)
        assert evaluate(environments, 3, 100_000) == first
        assert environments.vectors[0] is vectors[0]
    with Environments(config, n_envs=2) as environments:
        assert evaluate(environments, 3, 100_000) == first
    assert first.seeds == [100_000, 100_001, 100_002] and len(set(first.max_rewards)) > 1
