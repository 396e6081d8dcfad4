"""What a run's files depend on: another run's are never taken for its own."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.envs import EnvConfig

from lerobot_agpd.config import StudentConfig


def episode_identity(config: StudentConfig, env_config: EnvConfig, seed: int) -> dict[str, object]:
    """What decides a run's episodes, by flag; settings of another strategy than the run's are left out."""
    collect = config.collect
    identity: dict[str, object] = {
        "strategy": collect.strategy,
        "environment": {"type": env_config.type, "task": env_config.task},
        "teacher": config.teacher.path,
        "seed": seed,
        "teacher.num_inference_steps": config.teacher.num_inference_steps,
        "teacher.noise_scheduler": config.teacher.noise_scheduler,
        "collect.n_action_steps": collect.n_action_steps,
        "collect.min_reward": collect.min_reward,
        "collect.keep_failures": collect.keep_failures,
    }
    if collect.guides:
        identity |= {f"guidance.{name}": value for name, value in asdict(config.guidance).items()}
    if collect.guides or collect.strategy == "nearest":
        identity["representation.type"] = config.representation.type
        if config.representation.type == "visual":
            identity["representation.encoder"] = config.representation.encoder
    if collect.strategy == "mixing":
        identity["collect.mixing"] = asdict(collect.mixing)
    if collect.strategy == "nearest":
        identity["collect.nearest_samples"] = collect.nearest_samples
    return identity


def chunk_identity(
    config: StudentConfig, demonstrations: LeRobotDatasetMetadata, seed: int
) -> dict[str, object]:
    """What decides the teacher's chunks at recorded frames."""
    weights = Path(config.teacher.path) / SAFETENSORS_SINGLE_FILE
    return {
        **asdict(config.teacher),
        "weights": [weights.stat().st_size, weights.stat().st_mtime_ns] if weights.is_file() else None,
        "demonstrations": [demonstrations.repo_id, str(demonstrations.root), demonstrations.total_frames],
        "seed": seed,
    }
