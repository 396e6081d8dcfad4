"""Evaluate checkpoints with LeRobot's own rollouts, and keep what was measured."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
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

from lerobot_agpd.config import TeacherConfig
from lerobot_agpd.files import read_json, write_json
from lerobot_agpd.flag_checks import require
from lerobot_agpd.guidance.adapters import as_teacher
from lerobot_agpd.loading import load_policy, read_policy_config
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


@dataclass
class Evaluator:
    """Evaluations of checkpoints in one environment, stored in a folder and reused for the same request.

    Environments are built when first used and kept, since that takes seconds.

    Attributes:
        env_config: where policies act.
        n_envs: environments side by side.
        folder: gets a folder `evaluations`, one file per request, named by the request's hash.
        device: where policies run.
    """

    env_config: EnvConfig
    n_envs: int
    folder: Path
    device: str

    def close(self) -> None:
        """Close the environments."""
        if "environments" in self.__dict__:
            close_envs(self.environments)

    @cached_property
    def environments(self) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """LeRobot's vector environments, by suite and task."""
        return make_env(self.env_config, n_envs=self.n_envs, use_async_envs=False)

    def evaluate(
        self,
        path: Path | str,
        episodes: int,
        seed: int,
        n_action_steps: int | None = None,
        sampler: TeacherConfig | None = None,
    ) -> Evaluation:
        """Evaluate a checkpoint on `episodes` environments from `seed` on, unless that is known already.

        Args:
            path: of the checkpoint.
            episodes: number of environments.
            seed: of the first.
            n_action_steps: executed per prediction; None: as the checkpoint says.
            sampler: denoising steps and noise scheduler of a policy that denoises; None: as the checkpoint says.

        Raises:
            FlagError: if it cannot execute that many steps per prediction, or has no such sampler.
        """
        request = {
            "weights": digest(path),
            "env": draccus.encode(self.env_config, EnvConfig),
            "episodes": episodes,
            "seed": seed,
            "n_action_steps": n_action_steps,
            "batch_size": self.n_envs,
            "device": self.device,
        }
        if sampler is not None:
            request["sampler"] = [sampler.num_inference_steps, sampler.noise_scheduler]
        name = hashlib.sha256(json.dumps(request, sort_keys=True, default=str).encode()).hexdigest()[:16]
        file = self.folder / EVALUATIONS / f"{name}.json"
        if file.is_file():
            stored = read_json(file)
            return Evaluation(**{key: stored[key] for key in stored if key != "request"})
        config = checkpoint_config(path, self.device, n_action_steps)
        evaluation = self._roll_out(config, episodes, seed, sampler or TeacherConfig())
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, {"request": request, **asdict(evaluation)})
        logger.info("evaluated %s: success %s", path, success_rate(evaluation.successes))
        return evaluation

    def latency(self, path: Path | str) -> Latency:
        """Time one chunk of a checkpoint at batch size 1."""
        return chunk_latency(load_policy(checkpoint_config(path, self.device)).policy)

    def _roll_out(
        self, config: PreTrainedConfig, n_episodes: int, start_seed: int, sampler: TeacherConfig
    ) -> Evaluation:
        """Roll out episodes from consecutive seeds as `lerobot-eval` does; policies that sample are seeded, too."""
        loaded = load_policy(config)
        if sampler.num_inference_steps is not None or sampler.noise_scheduler is not None:
            teacher = as_teacher(
                loaded.policy, loaded.preprocessor, loaded.postprocessor
            )  # shares the policy
            teacher.set_sampler(sampler.num_inference_steps, sampler.noise_scheduler)
        processors = make_env_pre_post_processors(self.env_config, config)
        episodes: list[dict[str, Any]] = []
        for envs in (envs for suite in self.environments.values() for envs in suite.values()):
            with torch.no_grad(), seeded_context(start_seed):
                info = eval_policy(
                    envs,
                    loaded.policy,
                    *processors,
                    loaded.preprocessor,
                    loaded.postprocessor,
                    n_episodes=n_episodes,
                    start_seed=start_seed,
                )
            episodes += info["per_episode"]
        return Evaluation(
            successes=[bool(episode["success"]) for episode in episodes],
            max_rewards=[float(episode["max_reward"]) for episode in episodes],
            seeds=[int(episode["seed"]) for episode in episodes],
        )


def checkpoint_config(path: Path | str, device: str, n_action_steps: int | None = None) -> PreTrainedConfig:
    """Read the configuration of a checkpoint that is to execute a number of steps per prediction; None: its own.

    Raises:
        FlagError: if it cannot execute that many.
    """
    config: Any = read_policy_config(path, "checkpoint")
    config.device = device
    if n_action_steps is not None:
        require(
            1 <= n_action_steps <= config.n_action_steps,
            f"n_action_steps={n_action_steps}: {path} was trained to execute {config.n_action_steps} steps per "
            "prediction; it can execute fewer, at least 1, not more",
        )
        config.n_action_steps = n_action_steps
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
