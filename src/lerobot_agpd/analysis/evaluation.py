"""Evaluation of checkpoints with LeRobot's own rollouts, and their latency."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors
from lerobot.policies import PreTrainedPolicy, get_policy_class, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy

CHUNK_REPEATS = 50


@dataclass(frozen=True)
class Evaluation:
    """Episodes of one checkpoint, one entry per environment seed."""

    successes: list[bool]
    max_rewards: list[float]
    seeds: list[int]


@dataclass(frozen=True)
class Latency:
    """Time of one action chunk at batch size 1, in milliseconds, and the network's size."""

    median_ms: float
    p95_ms: float
    n_parameters: int
    threads: int


class Checkpoint:
    """A policy with its processors, ready to act."""

    def __init__(self, path: Path | str, device: str):
        """Load from a folder or Hub repository."""
        config = PreTrainedConfig.from_pretrained(path)
        config.device = device
        config.pretrained_path = Path(path)
        self.config = config
        self.policy: PreTrainedPolicy = get_policy_class(config.type).from_pretrained(path, config=config)
        self.preprocessor, self.postprocessor = make_pre_post_processors(
            config,
            pretrained_path=str(path),
            preprocessor_overrides={"device_processor": {"device": device}},
        )

    def evaluate(
        self, env_config: EnvConfig, n_episodes: int, batch_size: int, start_seed: int
    ) -> Evaluation:
        """Roll out n_episodes from consecutive seeds, as `lerobot-eval` does."""
        tasks = make_env(env_config, n_envs=min(batch_size, n_episodes), use_async_envs=False)
        processors = make_env_pre_post_processors(env_config, self.config)
        episodes: list[dict[str, Any]] = []
        try:
            for suite in tasks.values():
                for envs in suite.values():
                    with torch.no_grad():
                        info = eval_policy(
                            envs,
                            self.policy,
                            *processors,
                            self.preprocessor,
                            self.postprocessor,
                            n_episodes=n_episodes,
                            start_seed=start_seed,
                        )
                    episodes += info["per_episode"]
        finally:
            close_envs(tasks)
        return Evaluation(
            successes=[bool(episode["success"]) for episode in episodes],
            max_rewards=[float(episode["max_reward"]) for episode in episodes],
            seeds=[int(episode["seed"]) for episode in episodes],
        )

    def latency(self, repeats: int = CHUNK_REPEATS) -> Latency:
        """Time `predict_action_chunk` on random observations."""
        batch = {
            key: torch.randn(1, *feature.shape, device=self.config.device)
            for key, feature in (self.config.input_features or {}).items()
        }
        if self.config.n_obs_steps > 1:
            history = self.config.n_obs_steps
            batch = {
                key: value[:, None].expand(-1, history, *value.shape[1:]) for key, value in batch.items()
            }
        times = []
        for repeat in range(repeats + 3):  # the first ones warm up
            self.policy.reset()
            start = time.perf_counter()
            self.policy.predict_action_chunk(dict(batch))
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if repeat >= 3:
                times.append(1e3 * (time.perf_counter() - start))
        return Latency(
            median_ms=float(np.median(times)),
            p95_ms=float(np.quantile(times, 0.95)),
            n_parameters=acting_parameters(self.policy),
            threads=torch.get_num_threads(),
        )


def acting_parameters(policy: PreTrainedPolicy) -> int:
    """Parameters of the acting network; a student's discriminator and representation only train."""
    network = getattr(policy, "model", policy)
    return sum(parameter.numel() for parameter in network.parameters())


def checkpoint_steps(run: Path) -> dict[int, Path]:
    """Training step to policy folder of every checkpoint of a `lerobot-train` run, in order.

    Raises:
        FileNotFoundError: if the folder has none.
    """
    found = {
        int(folder.name): folder / "pretrained_model"
        for folder in sorted((run / "checkpoints").glob("*"))
        if folder.name.isdigit()
    }
    if not found:
        raise FileNotFoundError(f"{run} holds no checkpoints of a lerobot-train run")
    return found
