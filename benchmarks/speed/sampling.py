"""A teacher's chunks with and without guidance, and the time of one chunk of teacher and student."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors
from loops import PICK_AND_PLACE, Loop, train_config
from timing import Row, in_turn
from training import NO_ADVERSARY, NO_ROUNDS

from lerobot_agpd.config import TeacherConfig
from lerobot_agpd.guidance.adapters import as_teacher
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.guidance.teacher_student import TeacherStudent
from lerobot_agpd.loading import load_teacher
from lerobot_agpd.student import StudentSampler
from lerobot_agpd.studies.latency import random_observations

BATCH = 16
"""The environments of a round."""

PUBLISHED_STEPS = 5
"""Of the published teacher, whose steps take about 0.1 s each on a core: guidance costs the same at every step."""

SAMPLERS = {"10 DDIM": ("DDIM", 10), "100 DDPM": ("DDPM", 100)}
PUBLISHED = {
    "denoiser": "unet",
    "down_dims": (256, 512, 1024),
    "diffusion_step_embed_dim": 256,
    "n_obs_steps": 2,
    "horizon": 16,
    "n_action_steps": 8,
}
"""DP-C for low-dimensional observations in arXiv:2303.04137, as its published configuration has it."""


def student(device: str) -> Loop:
    """A student with a learned J."""
    flags = (NO_ROUNDS, NO_ADVERSARY, "--policy.representation.type=state", f"--policy.device={device}")
    loop = Loop(train_config(*flags, preset="student_cpu"))
    loop.step()
    loop.policy.eval()
    return loop


def published_teacher(loop: Loop, device: str) -> Teacher:
    """A teacher of published size with random weights."""
    features = {
        "input_features": loop.config.policy.input_features,
        "output_features": loop.config.policy.output_features,
    }
    config = PreTrainedConfig.get_choice_class("diffusion_transformer")(
        device=device, push_to_hub=False, **features, **PUBLISHED
    )
    policy = get_policy_class(config.type)(config).to(device).eval().requires_grad_(False)
    stats = loop.policy.agpd.replay.demonstrations.normalizer.stats
    return as_teacher(policy, *make_pre_post_processors(config, dataset_stats=stats))


def guidance(device: str) -> dict[str, Row]:
    """Chunks for 16 observations."""
    loop = student(device)
    small = load_teacher(TeacherConfig(path=str(PICK_AND_PLACE / "teacher")), device)
    rows: dict[str, Row] = {}
    for sampler, (scheduler, steps) in SAMPLERS.items():
        small.set_sampler(steps, scheduler)
        rows |= in_turn(compared(f"small MLP, {sampler}", loop, small), turns=7, calls=200 // steps)
    published = published_teacher(loop, device)
    published.set_sampler(PUBLISHED_STEPS, "DDIM")
    return rows | in_turn(compared(f"published U-Net, {PUBLISHED_STEPS} DDIM", loop, published), turns=3)


def compared(name: str, loop: Loop, teacher: Teacher) -> dict[str, Callable[[], object]]:
    """Unguided sampling, and guided by both J."""
    policy = loop.policy
    sampler = StudentSampler(policy, policy.agpd.replay.demonstrations.normalizer)
    learned = sampler.pair_with(teacher)
    pairs = {"J on actions": _without_representation(learned), "learned J": learned}
    frames = torch.arange(BATCH) * 7
    history = policy.agpd.replay.history(frames, list(teacher.input_features), learned.n_obs_steps)
    with torch.no_grad():
        chunk_hat = learned.propose(history)
    generator = torch.Generator(device=chunk_hat.device)
    strength = torch.ones(BATCH, device=chunk_hat.device)

    def guided(pair: TeacherStudent) -> Callable[[], object]:
        @torch.no_grad()
        def sample() -> torch.Tensor:
            action_j = pair.action_discrepancy(chunk_hat)
            guide = Guide(pair.guiding_discrepancy(history, chunk_hat, action_j), strength)
            return teacher.sample(history, guide, generator.manual_seed(0))

        return sample

    alone = {f"{name}, unguided": lambda: teacher.sample(history, None, generator.manual_seed(0))}
    return alone | {f"{name}, {kind}": guided(pair) for kind, pair in pairs.items()}


def _without_representation(pair: TeacherStudent) -> TeacherStudent:
    return replace(pair, make_discrepancy=None)


def latency(device: str) -> dict[str, Row]:
    """One chunk of one observation, by `predict_action_chunk`."""
    loop = student(device)
    config = PreTrainedConfig.from_pretrained(PICK_AND_PLACE / "teacher")
    config.device = device
    small = get_policy_class(config.type).from_pretrained(PICK_AND_PLACE / "teacher", config=config).eval()
    policies = {
        "student of the CPU preset": loop.policy,
        "teacher of FetchPickAndPlace, 10 DDIM": small,
        "teacher of published size, 10 DDIM": published_teacher(loop, device).policy,
    }
    policies["teacher of published size, 10 DDIM"].diffusion.num_inference_steps = 10
    return in_turn({name: _predict(policy) for name, policy in policies.items()}, turns=5)


def _predict(policy: torch.nn.Module) -> Callable[[], object]:
    batch = random_observations(policy, 1)

    def predict() -> torch.Tensor:
        policy.reset()
        return policy.predict_action_chunk(dict(batch))

    return predict
