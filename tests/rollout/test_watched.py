"""Environments that hang, die or never end: given up where that is possible, warned of elsewhere."""

import os
import re
import signal
import time

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from lerobot_agpd.replay.episode import EpisodeSpec
from lerobot_agpd.rollout.rollout import Rollouts
from lerobot_agpd.rollout.strategies import ChunkBatch
from lerobot_agpd.rollout.watched import WatchedEnvs, end_workers
from lerobot_agpd.stopwatch import Stopwatch

HANGS, DIES, ENDLESS = 66, 77, 88
"""Seeds of episodes that hang at their third step, whose process dies there, and that never end."""


class Fragile(gym.Env):
    """Ends with its fourth step, if nothing happens before."""

    observation_space = gym.spaces.Dict(agent_pos=gym.spaces.Box(-np.inf, np.inf, (2,), np.float32))
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    task_description = "hold on"

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seed, self.clock = seed, 0
        return self._observation(), {"is_success": False}

    def _observation(self):
        return {"agent_pos": np.array([self.seed or 0, self.clock], dtype=np.float32)}

    def step(self, action):
        self.clock += 1
        if self.clock == 3 and self.seed == HANGS:
            time.sleep(3600)
        if self.clock == 3 and self.seed == DIES:
            os.kill(os.getpid(), signal.SIGKILL)
        done = self.clock >= 4 and self.seed != ENDLESS
        return self._observation(), 0.0, done, False, {"is_success": done}


class Still:
    """A strategy that does nothing."""

    n_obs_steps = 1

    def __init__(self):
        self.stopwatch = Stopwatch()
        self.generator = torch.Generator()

    def act(self, history, strength, student_acts=None):
        return ChunkBatch(
            torch.zeros(len(strength), 1, 1), torch.zeros(len(strength)), torch.zeros(len(strength))
        )


def specs(*seeds):
    return [EpisodeSpec(number, seed, 0.0) for number, seed in enumerate(seeds)]


def rollouts(kind, n_envs, **options):
    workers = {"context": "fork"} if kind is AsyncVectorEnv else {}
    envs = kind([Fragile] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP, **workers)
    return Rollouts(envs, (lambda x: x, lambda x: x), Still(), **options)


@pytest.mark.parametrize(
    ("seed", "problem"), [(HANGS, r"in 1 s \(--policy.collect.step_timeout\)"), (DIES, "has ended")]
)
def test_an_environment_in_a_worker_process_is_given_up(seed, problem):
    """Episodes that ended before it stay; the caller learns of the one that was lost."""
    run = rollouts(AsyncVectorEnv, 2, step_timeout=1.0 if seed == HANGS else 30.0)
    began = time.monotonic()
    episodes = list(run.run(specs(1, 2, 3, seed, 5)))
    assert [episode.spec.seed for episode in episodes] == [1, 2, seed]
    assert episodes[0].problem is None and len(episodes[0]) == 4
    assert len(episodes[2]) == 2 and episodes[2].problem == run.problem
    assert re.search(problem, run.problem)
    end_workers(run.envs)
    assert not any(process.is_alive() for process in run.envs.processes)
    run.envs.close()
    assert time.monotonic() - began < 25


def test_a_synchronous_environment_that_hangs_is_warned_of(caplog):
    class Slow(Fragile):
        def step(self, action):
            time.sleep(0.5 if self.clock == 1 else 0)
            return super().step(action)

    watched = WatchedEnvs(SyncVectorEnv([Slow]), timeout=0.2)
    with watched.watching():
        watched.reset(seed=[1], options={})
        for _ in range(3):
            watched.step(np.zeros((1, 1), dtype=np.float32))
    (warning,) = [record.getMessage() for record in caplog.records]
    assert "--policy.collect.step_timeout" in warning and "--policy.collect.use_async_envs=true" in warning


@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
def test_an_episode_that_never_ends_is_cut_off(kind, caplog):
    run = rollouts(kind, 2, max_steps=6, step_timeout=30.0)
    episodes = {e.spec.seed: e for e in run.run(specs(ENDLESS, 1, 2, ENDLESS, 3))}
    run.envs.close()
    assert {seed: len(episode) for seed, episode in episodes.items()} == {ENDLESS: 6, 1: 4, 2: 4, 3: 4}
    assert episodes[ENDLESS].problem is None and episodes[ENDLESS].is_success is False
    (warning,) = [r.getMessage() for r in caplog.records if "cut off" in r.getMessage()]
    assert f"environment seed {ENDLESS}" in warning and "6 steps" in warning
