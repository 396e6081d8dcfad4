"""Evaluate checkpoints with LeRobot's own rollouts, and keep what was measured."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import draccus
import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy
from lerobot.utils.constants import CHECKPOINTS_DIR, PRETRAINED_MODEL_DIR
from lerobot.utils.random_utils import seeded_context

from lerobot_agpd.files import read_json, write_json
from lerobot_agpd.loading import load_policy
from lerobot_agpd.studies.latency import Latency, chunk_latency
from lerobot_agpd.studies.provenance import digest
from lerobot_agpd.studies.statistics import success_rate

logger = logging.getLogger(__name__)

EVALUATIONS = "evaluations"
MEASURES = {"success": "successes", "max_reward": "max_rewards"}
"""What a checkpoint is measured by, and the field of an evaluation that holds it."""


@dataclass(frozen=True)
class Evaluation:
    """Episodes of one checkpoint, one entry per environment seed."""

    successes: list[bool]
    max_rewards: list[float]
    seeds: list[int]

    def values(self, measure: str) -> list[Any]:
        """A measure in every episode."""
        return list(getattr(self, MEASURES[measure]))

    def mean(self, measure: str) -> float:
        """The measure's mean over the episodes."""
        return float(np.mean(self.values(measure)))


class Environments:
    """Vector environments, built when first used and kept: building some takes seconds. Leaving the context closes them."""

    def __init__(self, config: EnvConfig, n_envs: int):
        self.config = config
        self.n_envs = n_envs
        self._suites: dict[str, dict[int, gym.vector.VectorEnv]] = {}

    @property
    def vectors(self) -> list[gym.vector.VectorEnv]:
        """One vector environment per task."""
        if not self._suites:
            self._suites = make_env(self.config, n_envs=self.n_envs, use_async_envs=False)
        return [envs for suite in self._suites.values() for envs in suite.values()]

    def __enter__(self) -> Environments:
        """Build nothing yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the environments."""
        close_envs(self._suites)
        self._suites = {}


class Checkpoint:
    """A policy with its processors, ready to act.

    Args:
        path: folder or Hub repository.
        device: where it runs.
        n_action_steps: steps executed per prediction; None: the checkpoint's.

    Raises:
        ValueError: if it cannot execute that many.
    """

    def __init__(self, path: Path | str, device: str, n_action_steps: int | None = None):
        self.config = checkpoint_config(path, n_action_steps)
        self.config.device = device
        self.loaded = load_policy(self.config)

    def evaluate(self, environments: Environments, n_episodes: int, start_seed: int) -> Evaluation:
        """Roll out episodes from consecutive seeds as `lerobot-eval` does; policies that sample are seeded, too."""
        processors = make_env_pre_post_processors(environments.config, self.config)
        episodes: list[dict[str, Any]] = []
        for envs in environments.vectors:
            with torch.no_grad(), seeded_context(start_seed):
                info = eval_policy(
                    envs,
                    self.loaded.policy,
                    *processors,
                    self.loaded.preprocessor,
                    self.loaded.postprocessor,
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
        """Time one chunk at batch size 1."""
        return chunk_latency(self.loaded.policy)


class Evaluator:
    """Evaluations of checkpoints in one environment, stored in a folder and reused for the same request.

    Args:
        environments: where they act.
        folder: gets a folder `evaluations`, one file per request, named by the request's hash.
        device: where policies run.
    """

    def __init__(self, environments: Environments, folder: Path, device: str):
        self.environments = environments
        self.folder = folder / EVALUATIONS
        self.device = device

    def evaluate(
        self, path: Path | str, episodes: int, seed: int, n_action_steps: int | None = None
    ) -> Evaluation:
        """Evaluate a checkpoint on `episodes` environments from `seed` on, unless that is known already."""
        request = {
            "weights": digest(path),
            "env": draccus.encode(self.environments.config, EnvConfig),
            "episodes": episodes,
            "seed": seed,
            "n_action_steps": n_action_steps,
            "batch_size": self.environments.n_envs,
            "device": self.device,
        }
        stored = read_evaluation(self.folder, request)
        if stored is not None:
            return stored
        checkpoint = Checkpoint(path, self.device, n_action_steps)
        evaluation = checkpoint.evaluate(self.environments, episodes, seed)
        store_evaluation(self.folder, request, evaluation)
        logger.info("evaluated %s: success %s", path, success_rate(evaluation.successes))
        return evaluation

    def latency(self, path: Path | str, n_action_steps: int | None = None) -> Latency:
        """Time one chunk of a checkpoint."""
        return Checkpoint(path, self.device, n_action_steps).latency()


def store_evaluation(folder: Path, request: Mapping[str, Any], evaluation: Evaluation) -> Path:
    """Write an evaluation with the request that it answers; returns the file."""
    folder.mkdir(parents=True, exist_ok=True)
    file = _file(folder, request)
    write_json(file, {"request": request, **asdict(evaluation)})
    return file


def read_evaluation(folder: Path, request: Mapping[str, Any]) -> Evaluation | None:
    """Read a stored evaluation; None if it is missing, damaged, or not whole."""
    file = _file(folder, request)
    if not file.is_file():
        return None
    try:
        content = read_json(file)
        evaluation = Evaluation(**{key: content[key] for key in ("successes", "max_rewards", "seeds")})
    except (ValueError, KeyError) as error:
        logger.warning("evaluating again: %s", error)
        return None
    seeds = list(range(request["seed"], request["seed"] + request["episodes"]))
    lengths = {len(evaluation.successes), len(evaluation.max_rewards)}
    return evaluation if evaluation.seeds == seeds and lengths == {len(seeds)} else None


def _file(folder: Path, request: Mapping[str, Any]) -> Path:
    text = json.dumps(request, sort_keys=True, default=str)
    return folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"


def checkpoint_config(path: Path | str, n_action_steps: int | None = None) -> Any:
    """Read the configuration of a checkpoint that is to execute a number of steps per prediction; None: its own.

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
    steps = {
        int(folder.name): folder / PRETRAINED_MODEL_DIR
        for folder in sorted((run / CHECKPOINTS_DIR).glob("*"))
        if folder.name.isdigit()
    }
    if not steps:
        raise FileNotFoundError(f"{run} holds no checkpoints of a lerobot-train run")
    return steps


def best_step(curve: Mapping[int, Evaluation], measure: str) -> int:
    """The checkpoint with the highest mean of the measure.

    Ties, frequent with few episodes, go to the higher mean max reward, then to the later checkpoint.
    """
    return max(curve, key=lambda step: (curve[step].mean(measure), curve[step].mean("max_reward"), step))
