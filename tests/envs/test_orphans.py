"""Workers of environments after their run was killed."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PROGRAM = """
import multiprocessing, os, sys, time
import gymnasium as gym, numpy as np
from gymnasium.vector import AsyncVectorEnv

HANGS = sys.argv[1] == "hangs"

class Env(gym.Env):
    observation_space = action_space = gym.spaces.Box(-1, 1, (1,))
    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}
    def step(self, action):
        time.sleep(3600 if HANGS else 0)
        return np.zeros(1, np.float32), 0.0, False, False, {}

if __name__ == "__main__":
    multiprocessing.set_forkserver_preload(["lerobot_agpd.envs.orphans"])
    envs = AsyncVectorEnv([Env] * 2, context="forkserver")
    envs.reset()
    envs.step_async(np.zeros((2, 1), np.float32))
    print(*[process.pid for process in envs.processes], flush=True)
    time.sleep(3600)
"""


@pytest.mark.parametrize("state", ["waits", "hangs"])
def test_workers_end_with_a_killed_run(state, tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    process = subprocess.Popen([sys.executable, program, state], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    workers = [Path("/proc") / pid for pid in process.stdout.readline().split()]
    assert len(workers) == 2 and all(worker.exists() for worker in workers)
    process.send_signal(signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + 30
    while any(map(is_alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(map(is_alive, workers))


def is_alive(process: Path) -> bool:
    """Whether a process runs; one that has ended and waits to be noticed does not."""
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
