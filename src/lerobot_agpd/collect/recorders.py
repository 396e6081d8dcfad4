"""Recorders that look over the shoulder of a rollout: decisions and rendered frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv, VectorWrapper
from torch import Tensor

from lerobot_agpd.analysis.recording import Array, Chunks, DecisionRecord
from lerobot_agpd.collect.decider import Decision
from lerobot_agpd.collect.deciders.teacher import GuidedTeacher
from lerobot_agpd.collect.stopwatch import Stopwatch
from lerobot_agpd.guidance.teacher import History


class DecisionRecorder:
    """Decides as a guided teacher does, and remembers what the teacher alone and the student would have done.

    Attributes:
        decisions: of the running episode; the caller takes them and clears the list.
    """

    def __init__(self, guided: GuidedTeacher):
        """Record the decisions of `guided`, for one environment."""
        self.guided = guided
        self.decisions: list[DecisionRecord] = []

    @property
    def n_obs_steps(self) -> int:
        """The guided teacher's."""
        return self.guided.n_obs_steps

    @property
    def stopwatch(self) -> Stopwatch:
        """The guided teacher's."""
        return self.guided.stopwatch

    def decide(self, history: History, strength: Tensor, rolling_in: Tensor | None = None) -> Decision:
        """The guided decision; the unguided one is drawn first, from the same noise."""
        noise = self.guided.generator.get_state()
        alone = self.guided.decide(history, torch.zeros_like(strength))
        self.guided.generator.set_state(noise)
        decision = self.guided.decide(history, strength)
        n_steps = self.guided.pair.alignment.n_steps
        student = self.guided.pair.student_actions(history)
        self.decisions.append(
            DecisionRecord(
                step=len(self.decisions) * n_steps,
                chunks=Chunks(_first(alone.actions), _first(decision.actions), _first(student)),
                j_teacher=float(alone.j[0]),
                j_guided=float(decision.j[0]),
                shift_in_sigmas=float(decision.shift[0]),
            )
        )
        return decision


class FrameRecorder(VectorWrapper):
    """Renders the first environment before every step.

    Attributes:
        frames: of the running episode, (H, W, 3) uint8 each; a reset starts a new list.
    """

    def __init__(self, env: VectorEnv):
        """Render `env`."""
        super().__init__(env)
        self.frames: list[Array] = []

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset and render."""
        result = self.env.reset(seed=seed, options=options)
        self.frames = [self._render()]
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step and, unless the episode is over, render."""
        result = self.env.step(actions)
        _, _, terminated, truncated, _ = result
        if not (terminated[0] or truncated[0]):
            self.frames.append(self._render())
        return result

    def _render(self) -> Array:
        try:
            rendered = self.env.render()
        except Exception as error:
            raise RuntimeError(
                f"rendering failed ({error}). MuJoCo environments need an OpenGL backend: set the environment variable "
                "MUJOCO_GL=egl (GPU or Mesa) or MUJOCO_GL=osmesa (software); or record without frames: --render=false"
            ) from error
        frame = rendered[0] if rendered else None
        if not isinstance(frame, np.ndarray):
            raise RuntimeError(
                "the environment renders no pictures; pass --env.render_mode=rgb_array or --render=false"
            )
        return frame


def _first(chunks: Tensor) -> Array:
    return chunks[0].float().cpu().numpy()
