"""Commands and flags of the end-to-end tests: tiny networks, real environments."""

import importlib.metadata
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
from multiprocessing.process import BaseProcess
from pathlib import Path

import torch

from lerobot_agpd.plugin import FORKSERVER_PRELOAD

BIN = Path(sys.executable).parent
EXAMPLES = Path(__file__).parents[2] / "examples"
PLUGINS = Path(__file__).parents[1] / "plugins"

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


def dataset_flags(root: Path) -> list[str]:
    return ["--dataset.repo_id=local/test", f"--dataset.root={root}"]


# ---- what a run leaves behind ----


def last_checkpoint(output: Path) -> Path:
    return output / "checkpoints" / "last" / "pretrained_model"


def round_folder(output: Path, number: int) -> Path:
    return output / "agpd" / f"round-{number:05d}"


def reports(output: Path) -> list[dict]:
    """Reports of the finished rounds of a run."""
    paths = sorted((output / "agpd").glob("round-*/report.json"))
    return [json.loads(path.read_text()) for path in paths]


def records(output: Path, number: int, rank: int = 0) -> list[dict]:
    """Complete lines of a process's index of a round."""
    path = round_folder(output, number) / f"rank-{rank}.jsonl"
    return [json.loads(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []


# ---- commands in processes of their own, forked from one that has imported LeRobot ----

PROCESSES = multiprocessing.get_context("forkserver")


def start(command: str, *flags: object, log: Path) -> BaseProcess:
    """Start one of the console commands in the background; what it prints goes to `log`."""
    multiprocessing.set_forkserver_preload([*FORKSERVER_PRELOAD, "lerobot.scripts.lerobot_train"])
    process = PROCESSES.Process(target=_run_logged, args=(log, command, *map(str, flags)))
    process.start()
    return process


def run(command: str, *flags: object) -> str:
    """Run one of the console commands to its end and return what it printed."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        process = start(command, *flags, log=log)
        process.join(timeout=900)
        process.kill()  # nothing if it has ended; else pytest would wait for it at its own end
        process.join()
        output = log.read_text()
    assert process.exitcode == 0, output[-5000:]
    return output


def _run_logged(log: Path, command: str, *flags: str) -> None:
    with log.open("wb") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    os.environ.update(environment())
    torch.set_num_threads(1)
    run_here(command, *flags)


# ---- commands in this process ----


def run_here(command: str, *flags: object) -> None:
    """Run one of the console commands in this process."""
    entry_points = importlib.metadata.entry_points(group="console_scripts", name=command)
    main = next(iter(entry_points)).load()
    argv, sys.argv = sys.argv, [command, *map(str, flags)]
    try:
        main()
    finally:
        sys.argv = argv


# ---- commands from nothing, as in a shell ----


def run_afresh(command: str, *arguments: object) -> None:
    """Run one of the environment's programs."""
    words = [str(BIN / command), *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, env=environment(), timeout=900)
    assert done.returncode == 0, (done.stdout + done.stderr)[-5000:]
