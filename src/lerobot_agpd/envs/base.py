"""What the environment types share: raw observation keys, how one environment is built and how many."""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

AGENT_POS = "agent_pos"
ENVIRONMENT_STATE = "environment_state"
PIXELS = "pixels"
"""Raw keys that LeRobot's `preprocess_observation` turns into its own."""


def unbounded(dim: int) -> gym.spaces.Box:
    """Space of float32 vectors (dim,) without bounds."""
    return gym.spaces.Box(-np.inf, np.inf, shape=(dim,), dtype=np.float32)


def image_space(height: int, width: int) -> gym.spaces.Box:
    """Space of uint8 images (height, width, 3)."""
    return gym.spaces.Box(0, 255, shape=(height, width, 3), dtype=np.uint8)


def make_vector_env(factory: Callable[[], gym.Env], n_envs: int, use_async_envs: bool) -> VectorEnv:
    """Build a vector environment as LeRobot's `EnvConfig.create_envs` does, from a factory.

    LeRobot's own factory runs `gymnasium.make` alone and fails in forkserver workers, where nothing has imported the
    package that registers the id.

    Args:
        factory: builds one environment; a process that has imported nothing yet must be able to call it.
        n_envs: number of environments.
        use_async_envs: one process per environment, if there are at least two.

    Returns:
        The vector environment, autoreset in the same step.
    """
    factories = [factory] * n_envs
    if use_async_envs and n_envs > 1:
        return AsyncVectorEnv(factories, context="forkserver", autoreset_mode=AutoresetMode.SAME_STEP)
    return SyncVectorEnv(factories, autoreset_mode=AutoresetMode.SAME_STEP)


def require_packages(names: Sequence[str], env_type: str, extra: str) -> None:
    """Import packages that an optional extra of this one installs.

    Args:
        names: the packages; importing them registers their environments.
        env_type: who needs them.
        extra: that brings them.

    Raises:
        ModuleNotFoundError: naming the extra, if one of them or something that it needs is not installed.
    """
    try:
        for name in names:
            importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"The {env_type} environments need the package {error.name!r}, which is not installed. "
            f"Run: pip install 'lerobot_policy_agpd[{extra}]'",
            name=error.name,
        ) from error


class SingleEnvConfig(ABC):
    """Mixin for an `EnvConfig` whose environments are built from a factory, alone or several at a time."""

    # Of EnvConfig:
    type: str
    task: str | None
    fps: int | None
    # Of every type here:
    obs_type: str
    episode_length: int | None
    observation_height: int
    observation_width: int

    def check_options(self, obs_types: Collection[str], fps: int, episode_length: int | None = None) -> None:
        """Check what every type has, and fill in what the task decides where it was left at None.

        Args:
            obs_types: the known ones.
            fps: the simulation's, control steps per second.
            episode_length: the task's own limit, if it has one.

        Raises:
            ValueError: naming the option that cannot be.
        """
        if self.obs_type not in obs_types:
            raise ValueError(f"--env.obs_type must be one of {', '.join(obs_types)}; got {self.obs_type!r}.")
        self.fps = fps if self.fps is None else self.fps
        if self.fps != fps:
            raise ValueError(f"{self.task} runs at {fps} steps per second; --env.fps={self.fps} cannot be.")
        self.episode_length = episode_length if self.episode_length is None else self.episode_length
        if self.episode_length is None or self.episode_length < 1:
            raise ValueError(f"--env.episode_length must be at least 1, got {self.episode_length}.")
        if min(self.observation_height, self.observation_width) < 4:  # LeRobot takes 1 to 3 for channels
            raise ValueError(
                f"--env.observation_height={self.observation_height} and --env.observation_width="
                f"{self.observation_width} must be at least 4 pixels."
            )

    @property
    @abstractmethod
    def factory(self) -> Callable[[], gym.Env]:
        """Builds one environment; picklable, for worker processes that have imported nothing yet."""

    def make_single(self) -> gym.Env:
        """Build one environment outside any vector environment."""
        return self.factory()

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Build the vector environment; see `make_vector_env`.

        Args:
            n_envs: number of environments.
            use_async_envs: one process per environment, if there are at least two.

        Returns:
            `{type: {0: vector environment}}`.

        Raises:
            ModuleNotFoundError: if the package of the environment is not installed.
        """
        return {self.type: {0: make_vector_env(self.factory, n_envs, use_async_envs)}}
