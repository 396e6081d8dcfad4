"""What an environment shows, looked at once before training starts."""

from __future__ import annotations

from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors, preprocess_observation
from torch import Tensor

from lerobot_agpd.config import COLLECTION_SEEDS
from lerobot_agpd.replay.episode import Array
from lerobot_agpd.rollout.running_episode import as_recorded


def first_observation(env_config: EnvConfig, policy_config: PreTrainedConfig) -> dict[str, Array]:
    """The first observation of an episode as it would be recorded: vectors (D,), images (H, W, C)."""
    tasks = make_env(env_config, n_envs=1, use_async_envs=False)
    try:
        envs = next(envs for suite in tasks.values() for envs in suite.values())
        preprocess, _ = make_env_pre_post_processors(env_config, policy_config)
        observation, _ = envs.reset(seed=COLLECTION_SEEDS[0])
        processed = preprocess(preprocess_observation(observation))
        return {key: as_recorded(value[0]) for key, value in processed.items() if isinstance(value, Tensor)}
    finally:
        close_envs(tasks)
