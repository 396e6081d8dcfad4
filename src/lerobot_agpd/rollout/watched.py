"""A vector environment that is watched: none of its environments holds up a round without a word."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from gymnasium.vector import AsyncVectorEnv, VectorEnv

logger = logging.getLogger(__name__)


class StuckEnvironmentsError(Exception):
    """Environments that do not answer any more; their vector environment cannot be used again.

    Attributes:
        slots: which of the vector environment's.
        problem: what is wrong with them, for the records of their episodes.
    """

    def __init__(self, slots: list[int], problem: str):
        super().__init__(problem)
        self.slots, self.problem = slots, problem


class WatchedEnvs:
    """Resets and steps a vector environment, and notices if that takes too long.

    Environments in worker processes (gymnasium's AsyncVectorEnv) that are too slow, or whose process has ended, are given
    up. Synchronous ones share the process of the run, which nobody can take back from them: they are only warned of.

    Args:
        envs: the vector environment.
        timeout: seconds that a reset or a step may take; None: any time.
    """

    def __init__(self, envs: VectorEnv, timeout: float | None = None):
        self.envs, self.timeout = envs, timeout
        self._began: float | None = None  # the call that is running, if any
        self._ended = threading.Event()

    @contextmanager
    def watching(self) -> Iterator[WatchedEnvs]:
        """Warn, from a thread, of synchronous environments that take too long."""
        if self.timeout is None or isinstance(self.envs, AsyncVectorEnv):
            yield self
            return
        thread = threading.Thread(
            target=self._watch, args=(self.timeout,), name="environment watch", daemon=True
        )
        thread.start()
        try:
            yield self
        finally:
            self._ended.set()
            thread.join()

    def reset(self, seed: Any, options: dict[str, Any]) -> tuple[Any, Any]:
        """As `VectorEnv.reset`; raises StuckEnvironmentsError."""
        if isinstance(self.envs, AsyncVectorEnv):
            envs = self.envs
            return self._answers(lambda: envs.reset_async(seed=seed, options=options), envs.reset_wait)
        with self._measured():
            return self.envs.reset(seed=seed, options=options)

    def step(self, actions: Any) -> Any:
        """As `VectorEnv.step`; raises StuckEnvironmentsError."""
        if isinstance(self.envs, AsyncVectorEnv):
            envs = self.envs
            return self._answers(lambda: envs.step_async(actions), envs.step_wait)
        with self._measured():
            return self.envs.step(actions)

    # ---- worker processes ----

    def _answers(self, send: Callable[[], None], receive: Callable[[], Any]) -> Any:
        assert isinstance(self.envs, AsyncVectorEnv)
        try:
            send()
            stuck = self._late(time.monotonic())
            if stuck:
                raise StuckEnvironmentsError(
                    stuck,
                    f"no answer from the environment in {self.timeout:g} s (--policy.collect.step_timeout)",
                )
            return receive()
        except (EOFError, ConnectionError) as error:  # what is left of a killed worker
            for process in self.envs.processes:
                process.join(timeout=0.1)
            dead = [slot for slot, process in enumerate(self.envs.processes) if not process.is_alive()]
            if not dead:
                raise
            raise StuckEnvironmentsError(dead, "the environment's worker process has ended") from error

    def _late(self, began: float) -> list[int]:
        """Slots that have not answered within the time limit."""
        assert isinstance(self.envs, AsyncVectorEnv)
        if self.timeout is None:
            return []
        deadline = began + self.timeout
        pipes = enumerate(self.envs.parent_pipes)
        return [slot for slot, pipe in pipes if not pipe.poll(max(0.0, deadline - time.monotonic()))]

    # ---- the run's own process ----

    @contextmanager
    def _measured(self) -> Iterator[None]:
        self._began = time.monotonic()
        try:
            yield
        finally:
            self._began = None

    def _watch(self, timeout: float) -> None:
        warned = None
        while not self._ended.wait(timeout / 4):
            began = self._began
            if began is not None and began != warned and time.monotonic() - began > timeout:
                warned = began
                logger.warning(
                    "the environment has not finished a reset or step for %.0f s (--policy.collect.step_timeout). The round "
                    "waits: an environment in the run's own process cannot be given up, one in a worker process can "
                    "(--policy.collect.use_async_envs=true)",
                    time.monotonic() - began,
                )


def end_workers(envs: VectorEnv) -> None:
    """End the worker processes of a vector environment at once, whatever they do; for others there is nothing to do."""
    if not isinstance(envs, AsyncVectorEnv):
        return
    for process in envs.processes:
        process.kill()
        process.join()
    for pipe in envs.parent_pipes:
        if pipe is not None:  # gymnasium has closed those of environments that raised an error
            pipe.close()
    envs.closed = True
