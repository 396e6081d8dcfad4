"""Training steps: the student against LeRobot's `act`, the teacher against LeRobot's `diffusion`, both against their floor."""

from __future__ import annotations

import torch
from loops import PICK_AND_PLACE, Floor, Loop, train_config
from timing import Row, in_turn

TURNS, STEPS = 7, 4
"""Four steps per turn: the preset's adversary acts in every fourth."""

ENV = ("--env.type=gymnasium_robotics", "--env.task=FetchPickAndPlace-v4")
TEACHER = f"--policy.teacher.path={PICK_AND_PLACE}/teacher"
NO_ROUNDS, NO_ADVERSARY = "--policy.collect.every=0", "--policy.adversary.weight=0"
SIZES = (
    "--policy.chunk_size=16",
    "--policy.n_action_steps=8",
    "--policy.dim_model=128",
    "--policy.n_heads=4",
    "--policy.dim_feedforward=512",
    "--policy.n_encoder_layers=2",
    "--policy.use_vae=false",
    "--policy.dropout=0",
    "--policy.pre_norm=true",
)
"""Those of examples/presets/student_cpu.yaml, for LeRobot's own ACT."""

U_NET = (
    "--policy.horizon=16",
    "--policy.n_action_steps=8",
    "--policy.drop_n_last_frames=7",
    "--policy.down_dims=[64,128]",
    "--policy.diffusion_step_embed_dim=64",
)


def student(device: str) -> dict[str, Row]:
    """Steps of the ACT student of the CPU preset, batch 64."""
    on = f"--policy.device={device}"
    act = Loop(train_config("--policy.type=act", on, *SIZES))
    fixed = act.batch()
    ours = {
        "agpd, demonstrations alone": (NO_ROUNDS, NO_ADVERSARY),
        "agpd, adversary every 4 steps": (NO_ROUNDS, TEACHER, "--policy.adversary.start=0"),
        "agpd, adversary, learned J": (
            NO_ROUNDS,
            TEACHER,
            "--policy.adversary.start=0",
            "--policy.representation.type=state",
        ),
        "agpd, adversary, a round in T": (
            TEACHER,
            *ENV,
            "--policy.adversary.start=0",
            "--policy.collect.episodes=16",
        ),
    }
    loops = {name: Loop(train_config(on, *flags, preset="student_cpu")) for name, flags in ours.items()}
    with_round = loops["agpd, adversary, a round in T"]
    with_round.step()
    with_round.policy.agpd.grow()
    actions = {"network and optimizer alone": Floor(_act(device), fixed).step, "LeRobot's act": act.step}
    return in_turn(actions | {name: loop.step for name, loop in loops.items()}, TURNS, STEPS, warmup=2)


def _act(device: str) -> torch.nn.Module:
    return Loop(train_config("--policy.type=act", f"--policy.device={device}", *SIZES)).policy


def teacher(device: str) -> dict[str, Row]:
    """Steps of a small U-Net teacher, and of the residual MLP of the CPU preset (4 noise levels per frame), batch 64."""
    on = f"--policy.device={device}"
    ours = ("--policy.type=diffusion_transformer", on, "--policy.denoiser=unet", *U_NET)
    theirs = ("--policy.type=diffusion", on, *U_NET, "--policy.crop_shape=null")
    lerobots = Loop(train_config(*theirs))
    in_memory = Loop(train_config(*ours, "--policy.noise_samples_per_frame=1"))
    mlp = Loop(train_config(on, preset="teacher_cpu"))
    floor = Floor(Loop(train_config(*theirs)).policy, lerobots.batch())
    rows = in_turn(
        {
            "network and optimizer alone, U-Net": floor.step,
            "LeRobot's diffusion, U-Net": lerobots.step,
            "diffusion_transformer, U-Net": in_memory.step,
        },
        TURNS,
        STEPS,
    )
    chunks = Loop(train_config(on, "--policy.in_memory=false", preset="teacher_cpu"))
    floor = Floor(chunks.policy, chunks.batch())
    return rows | in_turn(
        {"network and optimizer alone, MLP": floor.step, "diffusion_transformer, MLP": mlp.step}, TURNS, STEPS
    )
