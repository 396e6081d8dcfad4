"""`--env.type=faulty_point`: the point environment of tests/plugins, with a fault in some of its episodes."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from lerobot.envs.configs import EnvConfig
from lerobot_env_point.config import PointEnv
from lerobot_env_point.env import Point

Fault = Literal["nan_state", "nan_reward", "hangs", "slow", "dies", "never_ends", "at_once", "never"]

LIMIT = 12
"""Steps after which an episode is truncated."""


class FaultyPoint(Point):
    """A point whose environment fails at the second step of some episodes, or at every step of all.

    Args:
        fault: what goes wrong.
        episodes: numbers of the episodes, counted by every environment from 0.
    """

    def __init__(self, fault: Fault, episodes: list[int]):
        self.fault, self.episodes, self.n_resets = fault, episodes, 0

    def reset(self, **options: Any) -> tuple[dict[str, np.ndarray], dict[str, bool]]:
        """Start an episode."""
        self.is_faulty, self.n_steps = self.n_resets in self.episodes, 0
        self.n_resets += 1
        return super().reset(**options)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, bool]]:
        """Move, if nothing goes wrong."""
        observation, reward, success, cut, info = super().step(action)
        self.n_steps += 1
        if not self.is_faulty:
            return observation, reward, success, cut, info
        if self.n_steps == 2:
            if self.fault == "nan_state":
                observation["agent_pos"][:] = np.nan
            elif self.fault == "nan_reward":
                reward = float("nan")
            elif self.fault in ("hangs", "slow"):
                time.sleep(3600 if self.fault == "hangs" else 3)
            elif self.fault == "dies":
                os.kill(os.getpid(), signal.SIGKILL)
        if self.fault in ("never", "never_ends"):
            success = False
        if self.fault == "at_once":
            success = True
        return observation, reward, success, cut, {"is_success": success}


@EnvConfig.register_subclass("faulty_point")
@dataclass
class FaultyPointEnv(PointEnv):
    """Its worker processes are forks of the run's."""

    fault: Fault = "nan_state"
    episodes: list[int] = field(default_factory=lambda: [1])

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        """Vector environments, by suite and task."""
        make: Callable[[], gym.Env] = partial(FaultyPoint, self.fault, self.episodes)
        if self.fault != "never_ends":
            make = partial(_limited, make)
        mode: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}
        if use_async_envs:
            return {self.type: {0: AsyncVectorEnv([make] * n_envs, context="fork", **mode)}}
        return {self.type: {0: SyncVectorEnv([make] * n_envs, **mode)}}


def _limited(make: Callable[[], gym.Env]) -> gym.Env:
    return TimeLimit(make(), LIMIT)
