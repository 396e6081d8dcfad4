"""Records of a guided rollout: its steps, its frames, and what teacher and student planned at every decision."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
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
        action_names: of the action's dimensions; default: their numbers.
    """

    episode: Episode
    decisions: Sequence[DecisionRecord]
    frames: Sequence[Array] = ()
    to_frame: Callable[[Array], Array] | None = None
    action_names: Sequence[str] = ()

    def name_of(self, dim: int) -> str:
        """Name of an action dimension."""
        return self.action_names[dim] if self.action_names else f"action {dim}"

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
        self.frames = [rendered_frame(self.env)]
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step and, unless the episode is over, render."""
        result = self.env.step(actions)
        _, _, terminated, truncated, _ = result
        if not (terminated[0] or truncated[0]):
            self.frames.append(rendered_frame(self.env))
        return result


def rendered_frame(env: VectorEnv) -> Array:
    """A frame (H, W, 3) uint8 of the first environment.

    Raises:
        RuntimeError: if the environment cannot render, with what to do.
    """
    try:
        rendered = env.render()
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


# ---- what an environment says of its actions ----


def plane_to_frame(env: VectorEnv, frame: Array | None) -> Callable[[Array], Array] | None:
    """How to draw actions that are positions in the frame; None if they are none, such as forces or velocities.

    They are positions if an action is where `agent_pos` shall be: two numbers with the same bounds. These bounds span the
    frame, as in Push-T; without a frame they are drawn in their own units.
    """
    space, observed = env.single_action_space, env.single_observation_space
    position = observed.get("agent_pos") if isinstance(observed, gym.spaces.Dict) else None
    if not (isinstance(space, gym.spaces.Box) and isinstance(position, gym.spaces.Box)):
        return None
    if space.shape != (2,) or position.shape != (2,) or not space.is_bounded():
        return None
    if not (np.allclose(space.low, position.low) and np.allclose(space.high, position.high)):
        return None
    low, high = space.low, space.high
    if frame is None:
        return lambda actions: actions
    size = np.array([frame.shape[1], frame.shape[0]])
    return lambda actions: (actions - low) / (high - low) * size


def action_names(env: VectorEnv) -> list[str]:
    """Names of the action's dimensions: `action_names` of the environment, else their numbers."""
    n_dims = int(np.prod(env.single_action_space.shape or (1,)))
    try:
        names = [str(name) for name in env.get_attr("action_names")[0]]  # type: ignore[attr-defined]
    except AttributeError:
        names = []
    return names if len(names) == n_dims else [f"action {dim}" for dim in range(n_dims)]
