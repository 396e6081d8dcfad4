"""What the environment types share: raw observation keys, options, features, and how environments are built."""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

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


def require_packages(names: Sequence[str], user: str, extra: str) -> None:
    """Import packages that an optional extra installs.

    Args:
        names: packages; importing them registers their environments.
        user: what needs them, for the message.
        extra: name of the extra.

    Raises:
        ModuleNotFoundError: naming the extra, if one of them or one of their requirements is not installed.
    """
    try:
        for name in names:
            importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{user} needs the package {error.name!r}, which is not installed. "
            f"Run: pip install 'lerobot_policy_agpd[{extra}]'",
            name=error.name,
        ) from error


RenderMode = Literal["rgb_array"]
"""Values of `--env.render_mode`. An alias, since draccus finds no comment of a field with quotes in its annotation."""


class SingleEnvConfig(ABC):
    """Mixin for an `EnvConfig` whose environments are built from a factory, alone or several at a time."""

    # Of EnvConfig:
    type: str
    task: str | None
    fps: int | None
    features: dict[str, PolicyFeature]
    features_map: dict[str, str]
    # Of every type here:
    obs_type: str
    episode_length: int | None
    render_mode: str
    observation_height: int
    observation_width: int

    def check_options(
        self, observed_keys: Mapping[str, tuple[str, ...]], fps: int, episode_length: int | None = None
    ) -> None:
        """Check the options of every type, and fill in what the task decides where it is None.

        Args:
            observed_keys: raw keys of every `obs_type`.
            fps: the simulation's control steps per second.
            episode_length: the task's own limit, if it has one.

        Raises:
            ValueError: naming the option that is impossible.
        """
        if self.obs_type not in observed_keys:
            raise ValueError(
                f"--env.obs_type must be one of {', '.join(observed_keys)}; got {self.obs_type!r}."
            )
        if self.render_mode != "rgb_array":
            raise ValueError(f"--env.render_mode={self.render_mode}: only rgb_array can be rendered.")
        self.fps = fps if self.fps is None else self.fps
        if self.fps != fps:
            raise ValueError(f"--env.fps={self.fps}: {self.task} runs at {fps} steps per second.")
        self.episode_length = episode_length if self.episode_length is None else self.episode_length
        if self.episode_length is None or self.episode_length < 1:
            raise ValueError(f"--env.episode_length must be at least 1, got {self.episode_length}.")
        if min(self.observation_height, self.observation_width) < 4:  # LeRobot takes 1 to 3 for channels
            raise ValueError(
                f"--env.observation_height={self.observation_height} and --env.observation_width="
                f"{self.observation_width} must be at least 4 pixels."
            )

    def set_features(
        self,
        keys: Sequence[str],
        action_dim: int,
        agent_pos_dim: int,
        environment_state_dim: int,
        image_keys: Mapping[str, str],
    ) -> None:
        """Declare the action and what is observed.

        Args:
            keys: observed raw keys.
            action_dim: length of an action.
            agent_pos_dim: length of `agent_pos`.
            environment_state_dim: length of `environment_state`.
            image_keys: raw key of every image to its LeRobot key.
        """
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (action_dim,))}
        self.features_map = {
            ACTION: ACTION,
            AGENT_POS: OBS_STATE,
            ENVIRONMENT_STATE: OBS_ENV_STATE,
            **image_keys,
        }
        if AGENT_POS in keys:
            self.features[AGENT_POS] = PolicyFeature(FeatureType.STATE, (agent_pos_dim,))
        if ENVIRONMENT_STATE in keys:
            self.features[ENVIRONMENT_STATE] = PolicyFeature(FeatureType.ENV, (environment_state_dim,))
        if PIXELS in keys:
            shape = (self.observation_height, self.observation_width, 3)
            self.features |= {key: PolicyFeature(FeatureType.VISUAL, shape) for key in image_keys}

    @property
    @abstractmethod
    def factory(self) -> Callable[[], gym.Env]:
        """Function that builds one environment; picklable, for worker processes that have imported nothing yet."""

    def make_single(self) -> gym.Env:
        """Build one environment."""
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
