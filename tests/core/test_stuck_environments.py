"""A round in which environments hang or die: their episodes are dropped and counted, the others are collected."""

import logging
import os
import signal
import time
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from lerobot.envs import EnvConfig
from point_environment import LIMIT, Point, PointEnv
from toy_run import EPISODES, SCALE

STUCK: dict[int, str] = {}
"""Environment seeds of episodes that get stuck at their second step, and how."""


class FragilePoint(Point):
    """Hangs, dies or goes on for ever."""

    def reset(self, *, seed=None, options=None):
        self.trouble, self.n_steps = STUCK.get(seed), 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        self.n_steps += 1
        if self.n_steps == 2 and self.trouble == "hangs":
            time.sleep(3600)
        if self.n_steps == 2 and self.trouble == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.trouble == "never ends":
            return self.observation(), 0.0, False, False, {"is_success": False}
        return super().step(action)


@EnvConfig.register_subclass("agpd_test_fragile_point")
@dataclass
class FragilePointEnv(PointEnv):
    """`--env.type=agpd_test_fragile_point`; workers are forks of the test."""

    def create_envs(self, n_envs, use_async_envs=False):
        mode = {"autoreset_mode": AutoresetMode.SAME_STEP}
        if use_async_envs:
            return {self.type: {0: AsyncVectorEnv([FragilePoint] * n_envs, context="fork", **mode)}}
        return {self.type: {0: gym.vector.SyncVectorEnv([FragilePoint] * n_envs, **mode)}}


@pytest.fixture
def stuck_run(start):
    """Starts a run in whose first round some episodes, by number, get stuck."""

    def start_stuck(trouble, numbers, **collect):
        run = start(env=FragilePointEnv(), collect=collect, steps=5)
        specs = run.agpd.collector.specs(0, SCALE)
        STUCK.update({specs[number].seed: trouble for number in numbers})
        return run

    yield start_stuck
    STUCK.clear()


@pytest.mark.parametrize(
    ("trouble", "text"), [("hangs", "--policy.collect.step_timeout"), ("dies", "has ended")]
)
def test_a_round_goes_on_without_the_environment_that_got_stuck(stuck_run, caplog, trouble, text):
    timeout = 2.0 if trouble == "hangs" else 60.0
    run = stuck_run(trouble, [1, 4], use_async_envs=True, step_timeout=timeout).train(until=4)
    records, (report,) = run.records(0), run.agpd.reports
    assert [record.number for record in records] == list(range(EPISODES))
    assert [record.number for record in records if record.invalid] == [1, 4]
    assert all(text in record.invalid for record in records if record.invalid)
    assert report.total.invalid == 2 and report.total.kept == sum(record.kept for record in records) > 0
    assert "its episode is dropped" in caplog.text and f"2 of {EPISODES} episodes are dropped" in caplog.text
    assert np.isfinite(run.logs[-1]["loss"])


def test_a_round_of_stuck_environments_ends_the_run(stuck_run):
    run = stuck_run("dies", range(EPISODES), use_async_envs=True)
    with pytest.raises(
        RuntimeError, match=rf"6 of 6 episodes.*has ended.*'{FragilePointEnv().type}' \(--env"
    ):
        run.train(until=3)


@pytest.mark.parametrize("use_async_envs", [False, True])
def test_an_environment_that_never_ends(stuck_run, caplog, use_async_envs):
    caplog.set_level(logging.WARNING)
    run = stuck_run("never ends", [0], use_async_envs=use_async_envs, max_episode_steps=2 * LIMIT).train(
        until=3
    )
    lengths = {record.number: record.length for record in run.records(0)}
    assert lengths[0] == 2 * LIMIT and max(length for number, length in lengths.items() if number) <= LIMIT
    assert not run.records(0)[0].invalid and "is cut off after 24 steps" in caplog.text
