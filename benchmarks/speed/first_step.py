"""From the shell to the end of the first training step: whole processes, and what their start is made of."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from statistics import median

from loops import EXAMPLES, PICK_AND_PLACE
from timing import Row
from training import ENV, SIZES, TEACHER

REPEATS = 2


def first_step(device: str) -> dict[str, Row]:
    """`lerobot-train --steps=1` of LeRobot's ACT and of ours with everything on."""
    data = [f"--dataset.root={PICK_AND_PLACE}/demonstrations", "--dataset.repo_id=local/speed"]
    common = [*data, f"--policy.device={device}", "--policy.push_to_hub=false", "--steps=1"]
    common += ["--save_checkpoint=false", "--env_eval_freq=0"]
    commands = {
        "python -c 'import lerobot.scripts.lerobot_train'": [
            sys.executable,
            "-c",
            "import lerobot.scripts.lerobot_train",
        ],
        "lerobot-train, act": ["lerobot-train", "--policy.type=act", *SIZES, *common, "--num_workers=0"],
        "lerobot-train, agpd": [
            "lerobot-train",
            f"--config_path={EXAMPLES}/presets/student_cpu.yaml",
            TEACHER,
            *ENV,
            *common,
        ],
    }
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
    for _ in range(REPEATS):
        for name, command in commands.items():
            with tempfile.TemporaryDirectory() as folder:
                output = [f"--output_dir={folder}/run"] if "lerobot-train" in command[0] else []
                taken[name].append(process_ms([*command, *output]))
    reference = taken["lerobot-train, act"]
    return {name: _row(times, reference) for name, times in taken.items()}


def process_ms(command: list[str]) -> tuple[float, float]:
    """CPU and wall milliseconds of a process."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return 1e3 * cpu, 1e3 * (time.perf_counter() - began)


def _row(times: list[tuple[float, float]], reference: list[tuple[float, float]]) -> Row:
    ratio = median(ours[0] / theirs[0] for ours, theirs in zip(times, reference, strict=True))
    cpu, wall = (median(column) for column in zip(*times, strict=True))
    return {"cpu_ms": cpu, "wall_ms": wall, "ratio": ratio}
