"""Rendered episodes as an animation shows them: of policies that act alone, and of a guided teacher."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.constants import ACTION
from lerobot.utils.random_utils import seeded_context

from lerobot_agpd.loading import load_policy
from lerobot_agpd.replay.episode import Array
from lerobot_agpd.studies.animation import Clip, Line, executed_lines
from lerobot_agpd.studies.evaluation import checkpoint_config
from lerobot_agpd.studies.recording import COLORS, RolloutRecord, plane_to_frame, rendered_frame


class SoloEnvironment:
    """One environment in which policies act one after the other.

    Args:
        env_config: the environment.
        device: where policies run.
    """

    def __init__(self, env_config: EnvConfig, device: str):
        self.env_config, self.device = env_config, device
        self.tasks = make_env(env_config, n_envs=1)
        self.env: gym.vector.VectorEnv = next(iter(next(iter(self.tasks.values())).values()))

    def close(self) -> None:
        """Close the environment."""
        close_envs(self.tasks)

    def clips(self, path: Path, seeds: Sequence[int], n_action_steps: int | None = None) -> list[Clip]:
        """Episodes of a checkpoint from given environment seeds; policies that sample are seeded, too.

        Args:
            path: of the checkpoint.
            seeds: of the environment, one per episode.
            n_action_steps: executed per prediction; None: as the checkpoint says.
        """
        config: Any = checkpoint_config(path, self.device, n_action_steps)
        loaded = load_policy(config)
        processors = make_env_pre_post_processors(self.env_config, config)
        clips = []
        for seed in seeds:
            frames: list[Array] = []

            def render(env: gym.vector.VectorEnv, frames: list[Array] = frames) -> None:
                frames.append(rendered_frame(env))

            with torch.no_grad(), seeded_context(seed):
                episode = rollout(
                    self.env,
                    loaded.policy,
                    *processors,
                    loaded.preprocessor,
                    loaded.postprocessor,
                    seeds=[seed],
                    render_callback=render,
                )
            n_steps = episode[ACTION].shape[1]
            frames = frames[:n_steps]  # behind the last step the next episode has begun
            to_frame = plane_to_frame(self.env, frames[0])
            lines = {}
            if to_frame is not None:
                lines = executed_lines(
                    episode[ACTION][0].numpy(), config.n_action_steps, to_frame, COLORS["student"]
                )
            clips.append(Clip(frames, bool(episode["success"].any()), lines))
        return clips


def side_by_side(
    env_config: EnvConfig, policies: dict[str, Path], seeds: Sequence[int], device: str
) -> dict[str, list[Clip]]:
    """Episodes of several checkpoints from the same environment seeds, by the checkpoints' names."""
    with closing(SoloEnvironment(env_config, device)) as environment:
        return {name: environment.clips(path, seeds) for name, path in policies.items()}


def guided_clip(rollout: RolloutRecord) -> Clip:
    """A guided rollout as an animation shows it: the three chunks of the running decision, where they can be drawn."""
    lines: dict[int, list[Line]] = {}
    if rollout.to_frame is not None:
        for decision in rollout.decisions:
            drawn = [Line(rollout.to_frame(chunk), COLORS[name]) for name, chunk in decision.chunks.items()]
            n_steps = len(decision.chunks["guided"])
            lines |= dict.fromkeys(range(decision.step, decision.step + n_steps), drawn)
    return Clip(rollout.frames, rollout.episode.is_success, lines)
