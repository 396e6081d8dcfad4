"""A teacher and a student whose chunks are known in closed form."""

from types import SimpleNamespace

import torch

from lerobot_agpd.collect.deciders.pair import Pair
from lerobot_agpd.guidance.alignment import Alignment
from lerobot_agpd.guidance.discrepancy import gradient
from lerobot_agpd.guidance.teacher import Teacher

STATE = "observation.state"
N_STEPS, N_CHUNK = 2, 3
TEACHER_UNIT, STUDENT_UNIT = 2.0, 5.0  # raw actions per unit of either normalised space


class NoisyTeacher(Teacher):
    """Every action of its chunk is the sum of the current state, plus `spread` units of noise.

    Guided, its chunk x in its own units becomes x - scale * grad J: for the action J and n steps, the point that
    lies the share `scale` of the way to the student's.
    """

    can_be_guided = True

    def __init__(self, spread=0.5, action_dim=1, n_obs_steps=2):
        self.policy = SimpleNamespace(config=SimpleNamespace(type="toy", n_obs_steps=n_obs_steps))
        self.spread, self.action_dim = spread, action_dim
        self.calls = []

    n_chunk_steps, n_action_steps, start = N_CHUNK, N_STEPS, 1

    def to_units(self, actions_raw):
        return actions_raw / TEACHER_UNIT

    def to_raw(self, actions):
        return actions * TEACHER_UNIT

    def sample(self, history, guide=None, generator=None):
        state = history[STATE]
        assert state.shape[1] >= self.n_obs_steps and len(history["task"]) == len(state)
        self.calls.append(len(state))
        shape = (len(state), N_CHUNK + self.start, self.action_dim)
        mean = self.to_units(state[:, -1].sum(dim=1))[:, None, None]
        chunk = mean + self.spread * torch.randn(shape, generator=generator)
        if guide is not None:
            step = gradient(guide.discrepancy, chunk)[1]
            chunk = chunk - guide.scale[:, None, None] * step
            guide.shift_in_sigmas.append(guide.scale)
        return self.to_raw(chunk[:, self.start :])

    def _sample_chunk(self, batch, guide, generator):
        raise NotImplementedError


class Replayer(NoisyTeacher):
    can_be_guided = False


def propose(history):
    """Chunks of four steps at minus the sum of the oldest state it is given, in the student's units."""
    first = -history[STATE][:, 0].sum(dim=1) / STUDENT_UNIT
    return first[:, None, None].expand(-1, 4, 1)


def alignment(teacher):
    return Alignment(
        start=teacher.start,
        n_steps=N_STEPS,
        teacher_units=teacher.to_units,
        teacher_raw=teacher.to_raw,
        student_units=lambda actions: actions / STUDENT_UNIT,
        student_raw=lambda actions: actions * STUDENT_UNIT,
    )


def make_pair(teacher=None, student=propose, **options) -> Pair:
    teacher = teacher or NoisyTeacher()
    return Pair(teacher, student, alignment(teacher), **options)


def noise(seed=3) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def histories(n=5, length=2, seed=0):
    """States (n, length, 2), and a task."""
    generator = torch.Generator().manual_seed(seed)
    return {
        STATE: torch.randn(n, length, 2, generator=generator),
        "task": [f"task {row}" for row in range(n)],
    }


def student_actions(history) -> torch.Tensor:
    """What the student does, (B, n, 1) raw."""
    return propose(history)[:, :N_STEPS] * STUDENT_UNIT
