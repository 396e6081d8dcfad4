"""Commands and flags of the end-to-end tests: tiny networks, real environments."""

import importlib.metadata
import os
import subprocess
import sys
from pathlib import Path

BIN = Path(sys.executable).parent

PICK = ["--env.type=gymnasium_robotics", "--env.task=FetchPickAndPlace-v4"]
QUIET = ["--num_workers=0", "--env_eval_freq=0", "--log_freq=10"]
TINY_STUDENT = [
    "--policy.type=agpd",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.chunk_size=8",
    "--policy.n_action_steps=8",
    "--policy.dim_model=32",
    "--policy.n_heads=2",
    "--policy.dim_feedforward=64",
    "--policy.n_encoder_layers=1",
    "--policy.n_vae_encoder_layers=1",
    "--policy.latent_dim=4",
    "--policy.optimizer_lr=1e-3",
    "--batch_size=16",
    *QUIET,
]
TINY_TEACHER = [
    "--policy.type=diffusion_transformer",
    "--policy.denoiser=mlp",
    "--policy.mlp.width=96",
    "--policy.mlp.n_blocks=2",
    "--policy.prediction_type=sample",
    "--policy.noise_scheduler_type=DDIM",
    "--policy.num_inference_steps=5",
    "--policy.optimizer_lr=2e-3",
    "--policy.scheduler_warmup_steps=20",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--batch_size=32",
    *QUIET,
]


def environment(**extra: str) -> dict[str, str]:
    """Variables of a command: offline, one thread, off-screen rendering."""
    return {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "MUJOCO_GL": "egl", **extra}


def start(*command: object, log: Path) -> subprocess.Popen[bytes]:
    """Start one of the environment's commands in the background."""
    words = [str(BIN / str(command[0])), *map(str, command[1:])]
    return subprocess.Popen(words, stdout=log.open("wb"), stderr=subprocess.STDOUT, env=environment())


def run(*command: object, expect_failure: bool = False) -> str:
    """Run a command to its end and return what it printed."""
    words = [str(BIN / str(command[0])), *map(str, command[1:])]
    done = subprocess.run(words, capture_output=True, text=True, env=environment(), timeout=900)
    output = done.stdout + done.stderr
    assert (done.returncode != 0) == expect_failure, output[-5000:]
    return output


def dataset_flags(root: Path) -> list[str]:
    return ["--dataset.repo_id=local/test", f"--dataset.root={root}"]


def run_here(command: str, *flags: object) -> None:
    """Run one of the console commands in this process, which saves importing everything anew."""
    entry_points = importlib.metadata.entry_points(group="console_scripts", name=command)
    main = next(iter(entry_points)).load()
    argv, sys.argv = sys.argv, [command, *map(str, flags)]
    try:
        main()
    finally:
        sys.argv = argv
