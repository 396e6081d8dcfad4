"""Runs that are killed or told to end, and continued by the command that they name."""

import json
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import PICK, TINY_STUDENT, dataset_flags, environment, last_checkpoint, records, run, start

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.slow


def test_killed_runs_lose_and_repeat_nothing(tmp_path: Path) -> None:
    counts = tmp_path / "counts.json"
    script = ROOT / "benchmarks" / "interruptions" / "campaign.py"
    command = [sys.executable, script, f"--output={counts}", "--times=6", "--every=60", "--minutes=10"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=1800)
    assert done.returncode == 0, done.stderr[-5000:]
    trials = json.loads(counts.read_text())["trials"]
    assert trials and all(trial["killed"] and not trial["problems"] for trial in trials), trials


def test_a_run_that_is_told_to_end_says_how_it_goes_on(
    fetch_demos: Path, fetch_teacher: Path, tmp_path: Path
) -> None:
    """SIGTERM in the first round, before any checkpoint; the two flags that it names make a run of the same episodes."""
    output, log = tmp_path / "run", tmp_path / "log"
    flags = [
        *TINY_STUDENT,
        *PICK,
        *dataset_flags(fetch_demos),
        f"--policy.teacher.path={fetch_teacher}",
        "--policy.collect.warmup=2",
        "--policy.collect.every=2",
        "--policy.collect.episodes=6",
        "--policy.collect.n_envs=2",
        "--policy.adversary.start=1",
        "--steps=4",
    ]
    process = start("lerobot-train", *flags, f"--output_dir={output}", log=log)
    deadline = time.monotonic() + 600
    while not records(output, 0):
        assert process.is_alive() and time.monotonic() < deadline, log.read_text()[-5000:]
        time.sleep(0.02)
    process.terminate()
    process.join(timeout=60)
    assert process.exitcode == -signal.SIGTERM
    before, text = records(output, 0), log.read_text()
    assert text.count(f"collected episodes are kept in {output / 'agpd'}") == 1
    (message,) = [line for line in text.splitlines() if "interrupted by SIGTERM" in line]
    named = shlex.split(message.rpartition("two flags: ")[2])
    assert named == [f"--output_dir={output}-2", f"--policy.replay.root={output / 'agpd'}"]
    run("lerobot-train", *flags, *named)
    after = records(output, 0)
    assert after[: len(before)] == before and sorted(record["number"] for record in after) == list(range(6))
    assert last_checkpoint(Path(f"{output}-2")).is_dir()
