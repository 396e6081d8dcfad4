"""The environments of collection: as many as can be busy, built once and used for every round."""

from __future__ import annotations

from functools import cached_property
from math import ceil

from gymnasium.vector import AsyncVectorEnv, VectorEnv
from lerobot.envs import EnvConfig, close_envs, make_env

from lerobot_agpd.rollout.rollout import step_limit
from lerobot_agpd.rollout.watched import end_workers


def slots(n_episodes: int, most: int) -> int:
    """How many environments share a number of episodes: in as few waves as `most` allow, with all slots busy in each.

    A slot whose episodes are done is stepped until the others are done too.
    """
    n_waves = ceil(n_episodes / most)
    return ceil(n_episodes / n_waves)


class KeptEnvironments:
    """LeRobot's vector environments, one for each task of the configuration.

    Args:
        config: of the environment.
        use_async: whether each environment has a process of its own.
    """

    def __init__(self, config: EnvConfig, use_async: bool):
        self.config, self.use_async = config, use_async
        self._tasks: dict[str, dict[int, VectorEnv]] = {}
        self._size = 0

    def of_size(self, n_envs: int) -> list[VectorEnv]:
        """Vector environments of `n_envs` environments each; those of the last call if they have that size."""
        if n_envs != self._size or not self._tasks:
            self.close()
            self._tasks = make_env(self.config, n_envs=n_envs, use_async_envs=self.use_async)
            self._size = n_envs
        return self._all

    @property
    def _all(self) -> list[VectorEnv]:
        return [envs for suite in self._tasks.values() for envs in suite.values()]

    @cached_property
    def step_limit(self) -> int | None:
        """Steps after which the environments end every episode; None if one of them does not say."""
        tasks, of_its_own = self._tasks, False
        if not tasks or any(isinstance(envs, AsyncVectorEnv) for envs in self._all):
            # A worker process that is asked for an attribute that it lacks ends; an environment in this one does not.
            tasks, of_its_own = make_env(self.config, n_envs=1, use_async_envs=False), True
        limits = [step_limit(envs) for suite in tasks.values() for envs in suite.values()]
        if of_its_own:
            close_envs(tasks)
        known = [limit for limit in limits if limit is not None]
        return max(known) if len(known) == len(limits) else None

    def end(self) -> None:
        """Give the environments up, whatever their processes do."""
        for envs in self._all:
            end_workers(envs)
        self.close()

    def close(self) -> None:
        """Close the environments, if there are any; the next call of `of_size` builds new ones."""
        tasks, self._tasks = self._tasks, {}
        if tasks:
            close_envs(tasks)
