"""Records of a guided rollout: its steps, its frames, and what teacher and student planned at every decision."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv, VectorWrapper

from lerobot_agpd.agpd import GuidedStrategy
from lerobot_agpd.replay.episode import Array, Episode
from lerobot_agpd.rollout.rollout import Decision

COLORS = {"teacher": (0, 114, 178), "guided": (213, 94, 0), "student": (230, 60, 180)}
LABELS = {"teacher": "teacher alone", "guided": "guided teacher", "student": "student"}


@dataclass(frozen=True)
class DecisionRecord:
    """One decision of a rollout.

    Attributes:
        step: environment step at which the chunks begin.
        chunks: `teacher` (without guidance, from the same initial noise), `guided` (executed) and `student` (what it
            was pulled toward), (n, A) in the environment's units.
        teacher_discrepancy: J between the teacher's own chunk and the student's.
        guided_discrepancy: J between the executed chunk and the student's.
        guidance_shift: mean shift of the guided denoising steps, in sigmas; NaN without guidance.
    """

    step: int
    chunks: Mapping[str, Array]
    teacher_discrepancy: float
    guided_discrepancy: float
    guidance_shift: float


@dataclass(frozen=True)
class RolloutRecord:
    """A rollout of T steps.

    Attributes:
        episode: observations, actions, rewards and successes.
        decisions: in the order of their steps.
        frames: T rendered frames (H, W, 3) uint8, or none.
        to_frame: maps actions (n, 2) to pixels (n, 2) of the frame; None if actions are no positions in it.
    """

    episode: Episode
    decisions: Sequence[DecisionRecord]
    frames: Sequence[Array] = ()
    to_frame: Callable[[Array], Array] | None = None

    def observed(self, ndim: int) -> dict[str, Array]:
        """Observations that are images (T, H, W, C), with 4 dimensions, or vectors (T, D), with 2."""
        return {key: values for key, values in self.episode.observations.items() if values.ndim == ndim}


class DecisionRecorder:
    """Record what the teacher alone and the student would have done at every decision of a guided rollout.

    Made to be the `on_decision` of a rollout in one environment.

    Args:
        guided: the strategy that decides.

    Attributes:
        decisions: of the running episode; the caller takes them and clears the list.
    """

    def __init__(self, guided: GuidedStrategy):
        self.guided = guided
        self.decisions: list[DecisionRecord] = []

    def __call__(self, decision: Decision) -> None:
        """Sample the teacher again, from the noise of the decision; later decisions stay as they are."""
        generator, pair = self.guided.generator, self.guided.pair
        noise = generator.get_state()
        generator.set_state(decision.noise)
        alone = self.guided.act(decision.history, torch.zeros_like(decision.strength))
        generator.set_state(noise)
        actions = {
            "teacher": alone.actions,
            "guided": decision.chunks.actions,
            "student": pair.student_actions(decision.history),
        }
        self.decisions.append(
            DecisionRecord(
                step=len(self.decisions) * pair.n_steps,
                chunks={name: chunk[0].float().cpu().numpy() for name, chunk in actions.items()},
                teacher_discrepancy=float(alone.discrepancy[0]),
                guided_discrepancy=float(decision.chunks.discrepancy[0]),
                guidance_shift=float(decision.chunks.guidance_shift[0]),
            )
        )


class FrameRecorder(VectorWrapper):
    """Render the first environment before every step.

    Attributes:
        frames: of the running episode, (H, W, 3) uint8 each; a reset starts a new list.
    """

    def __init__(self, env: VectorEnv):
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
        if not rendered or not isinstance(rendered[0], np.ndarray):
            raise RuntimeError(
                "the environment renders no pictures; pass --env.render_mode=rgb_array or --render=false"
            )
        return rendered[0]
