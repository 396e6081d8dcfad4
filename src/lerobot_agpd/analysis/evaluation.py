"""Evaluation of checkpoints with LeRobot's own rollouts, and their latency."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors
from lerobot.policies import PreTrainedPolicy, get_policy_class, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy
from lerobot.utils.random_utils import seeded_context

from lerobot_agpd.analysis.latency import Latency, chunk_latency


@dataclass(frozen=True)
class Evaluation:
    """Episodes of one checkpoint, one entry per environment seed."""

    successes: list[bool]
    max_rewards: list[float]
    seeds: list[int]


class Environments:
    """Environments side by side, built when first needed and kept: building some takes seconds.

    Use it as a context; leaving closes them.
    """

    def __init__(self, config: EnvConfig, n_envs: int):
        """Remember what to build.

        Args:
            config: the environment.
            n_envs: how many are stepped side by side.
        """
        self.config = config
        self.n_envs = n_envs
        self._suites: dict[str, dict[int, Any]] = {}

    @property
    def vectors(self) -> list[Any]:
        """One vector environment per task."""
        if not self._suites:
            self._suites = make_env(self.config, n_envs=self.n_envs, use_async_envs=False)
        return [envs for suite in self._suites.values() for envs in suite.values()]

    def __enter__(self) -> Environments:
        """Nothing is built yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close what was built."""
        close_envs(self._suites)
        self._suites = {}


class Checkpoint:
    """A policy with its processors, ready to act."""

    def __init__(self, path: Path | str, device: str, n_action_steps: int | None = None):
        """Load from a folder or Hub repository.

        Args:
            path: of the checkpoint.
            device: where it runs.
            n_action_steps: steps executed per prediction; None: the checkpoint's.

        Raises:
            ValueError: if it cannot execute that many.
        """
        self.config = config = checkpoint_config(path, n_action_steps)
        config.device = device
        self.policy: PreTrainedPolicy = get_policy_class(config.type).from_pretrained(path, config=config)
        self.preprocessor, self.postprocessor = make_pre_post_processors(
            config,
            pretrained_path=str(path),
            preprocessor_overrides={"device_processor": {"device": device}},
        )

    def evaluate(self, environments: Environments, n_episodes: int, start_seed: int) -> Evaluation:
        """Roll out n_episodes from consecutive seeds, as `lerobot-eval` does; policies that sample do so reproducibly."""
        processors = make_env_pre_post_processors(environments.config, self.config)
        episodes: list[dict[str, Any]] = []
        for envs in environments.vectors:
            with torch.no_grad(), seeded_context(start_seed):
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
        return Evaluation(
            successes=[bool(episode["success"]) for episode in episodes],
            max_rewards=[float(episode["max_reward"]) for episode in episodes],
            seeds=[int(episode["seed"]) for episode in episodes],
        )

    def latency(self) -> Latency:
        """Time of one chunk at batch size 1."""
        return chunk_latency(self.policy)


def checkpoint_config(path: Path | str, n_action_steps: int | None = None) -> Any:
    """Configuration of a checkpoint that is to execute a number of steps per prediction; None: its own.

    Raises:
        ValueError: if it cannot execute that many.
    """
    config: Any = PreTrainedConfig.from_pretrained(path)
    if n_action_steps is not None:
        if not 1 <= n_action_steps <= config.n_action_steps:
            raise ValueError(
                f"n_action_steps={n_action_steps}: {path} was trained to execute {config.n_action_steps} steps per "
                "prediction; it can execute fewer, at least 1, not more"
            )
        config.n_action_steps = n_action_steps
    config.pretrained_path = Path(path)
    return config


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
