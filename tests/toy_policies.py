"""A teacher and a student whose chunks are known in closed form."""

from types import SimpleNamespace

import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.guidance.teacher_student import TeacherStudent

STATE = "observation.state"
N_STEPS, N_CHUNK = 2, 3
TEACHER_UNIT, STUDENT_UNIT = 2.0, 5.0  # raw actions per unit of either normalized space


class NoisyTeacher(Teacher):
    """Every action of its chunk is the sum of the current state, plus `spread` units of noise.

    Guided, its chunk x in its own units becomes x - scale * grad J: for the action J and n steps, the point that
    lies the fraction `scale` of the way to the student's.
    """

    can_be_guided = True
    n_chunk_steps, n_action_steps, start = N_CHUNK, N_STEPS, 1

    def __init__(self, spread=0.5, action_dim=1, n_obs_steps=2, state_dim=2):
        self.policy = SimpleNamespace(
            config=SimpleNamespace(
                type="toy",
                n_obs_steps=n_obs_steps,
                input_features={STATE: PolicyFeature(FeatureType.STATE, (state_dim,))},
                output_features={"action": PolicyFeature(FeatureType.ACTION, (action_dim,))},
            )
        )
        self.spread, self.action_dim = spread, action_dim
        self.calls = []

    def normalize(self, actions_raw):
        return actions_raw / TEACHER_UNIT

    def unnormalize(self, actions):
        return actions * TEACHER_UNIT

    def mean_action(self, state):
        """Its raw action (B, A) at states (B, D), without noise."""
        return state.sum(dim=1, keepdim=True).expand(-1, self.action_dim)

    def sample(self, history, guide=None, generator=None):
        state = history[STATE]
        assert state.shape[1] >= self.n_obs_steps and len(history["task"]) == len(state)
        self.calls.append(len(state))
        noise = torch.randn(len(state), N_CHUNK + self.start, self.action_dim, generator=generator)
        chunk = self.normalize(self.mean_action(state[:, -1]))[:, None] + self.spread * noise
        if guide is not None:
            step = guide.discrepancy.gradient(chunk)
            chunk = chunk - guide.scale[:, None, None] * step
            guide.shift_in_sigmas.append(guide.scale)
        return self.unnormalize(chunk[:, self.start :])

    def _sample_chunk(self, batch, guide, generator):
        raise NotImplementedError


class Unguidable(NoisyTeacher):
    can_be_guided = False


def propose(history):
    """Chunks of four steps at minus the sum of the oldest state it is given, in the student's units."""
    first = -history[STATE][:, 0].sum(dim=1) / STUDENT_UNIT
    return first[:, None, None].expand(-1, 4, 1)


def make_pair(teacher=None, student=propose, **options) -> TeacherStudent:
    return TeacherStudent(
        teacher=teacher or NoisyTeacher(),
        student=student,
        n_steps=N_STEPS,
        normalize=lambda actions: actions / STUDENT_UNIT,
        unnormalize=lambda actions: actions * STUDENT_UNIT,
        **options,
    )


def noise(seed=3) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def histories(n=5, length=2, seed=0):
    """States (n, length, 2), and a task."""
    state = torch.randn(n, length, 2, generator=noise(seed))
    return {STATE: state, "task": [f"task {row}" for row in range(n)]}


def student_actions(history) -> torch.Tensor:
    """What the student does, (B, n, 1) raw."""
    return propose(history)[:, :N_STEPS] * STUDENT_UNIT
