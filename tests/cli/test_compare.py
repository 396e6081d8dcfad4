"""`lerobot-agpd-compare`: its job control on small commands, and a real comparison killed midway."""

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml
from rich.console import Console

from lerobot_agpd.cli.compare import CompareConfig, load
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.studies.cluster import cluster_executor
from lerobot_agpd.studies.jobs import Job, run_jobs

pytest.importorskip("lerobot_policy_agpd")  # registers the environment types

ROOT = Path(__file__).parents[2]


def python(code: str) -> list[str]:
    return [sys.executable, "-S", "-c", code]


def job(tmp_path: Path, name: str, *codes: str) -> Job:
    """Runs Python programs one after the other."""

    commands, log = [python(code) for code in codes], tmp_path / f"{name}.log"

    def work(execute) -> None:
        for command in commands:
            execute(command, log)

    return Job(name, tmp_path / name, work)


# ---- job control


def test_jobs_run_their_commands_in_order_and_report_failures(tmp_path):
    write = "import os; open('{}', 'a').write(os.environ['OMP_NUM_THREADS'])"
    check = f"assert open({str(tmp_path / 'a')!r}).read() == '3'; open({str(tmp_path / 'b')!r}, 'w')"
    good = job(tmp_path, "good", write.format(tmp_path / "a"), check)
    bad = job(tmp_path, "bad", "import sys; sys.exit('the reason')", write.format(tmp_path / "never"))
    failures = run_jobs([bad, good], ThreadPoolExecutor(1), 3, Console(quiet=True))
    assert (tmp_path / "b").exists()
    assert list(failures) == ["bad"] and "ended with 1" in failures["bad"] and "the reason" in failures["bad"]
    assert not (tmp_path / "never").exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interrupt_ends_what_was_started(tmp_path, number):
    parent = f"""
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background commands ignore it
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from rich.console import Console
from lerobot_agpd.studies.jobs import Job, run_jobs
code = "import os, pathlib, time; pathlib.Path('{tmp_path}', str(os.getpid()) + '.pid').touch(); time.sleep(600)"
def work(execute):
    execute([sys.executable, "-S", "-c", code], Path("{tmp_path}/log"))
    execute([sys.executable, "-S", "-c", code], Path("{tmp_path}/log"))
run_jobs([Job(name, Path("{tmp_path}", name), work) for name in "abc"], ThreadPoolExecutor(2), 1, Console(quiet=True))
"""
    process = subprocess.Popen([sys.executable, "-c", parent], stderr=subprocess.PIPE, text=True)
    wait_for(lambda: len(list(tmp_path.glob("*.pid"))) == 2, process)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 1 and "run the same command to go on" in said
    children = [int(file.stem) for file in tmp_path.glob("*.pid")]
    assert len(children) == 2 and not any(Path(f"/proc/{child}").exists() for child in children)


def test_a_folder_that_another_process_works_on_is_left_alone(tmp_path):
    """The command that holds the lock outlives the process that started it, as after a kill -9."""
    ready, release, again = tmp_path / "ready", tmp_path / "release", tmp_path / "again"
    child = (
        "import pathlib, time\n"
        f"pathlib.Path({str(ready)!r}).touch()\n"
        f"while not pathlib.Path({str(release)!r}).exists(): time.sleep(.05)\n"
    )
    parent = (
        "import sys\nfrom concurrent.futures import ThreadPoolExecutor\nfrom pathlib import Path\nfrom rich.console import Console\n"
        "from lerobot_agpd.studies.jobs import Job, run_jobs\n"
        f"args = [sys.executable, '-S', '-c', {child!r}]\n"
        f"work = lambda execute: execute(args, Path({str(tmp_path / 'log')!r}))\n"
        f"run_jobs([Job('x', Path({str(tmp_path / 'x')!r}), work)], ThreadPoolExecutor(1), 1, Console(quiet=True))\n"
    )
    process = subprocess.Popen([sys.executable, "-c", parent])
    wait_for(ready.exists, process)
    process.kill()
    process.wait()
    next_one = job(tmp_path, "x", f"open({str(again)!r}, 'w')")
    assert (
        "another process works on" in run_jobs([next_one], ThreadPoolExecutor(1), 1, Console(quiet=True))["x"]
    )
    assert not again.exists()
    release.touch()
    wait_for(lambda: not run_jobs([next_one], ThreadPoolExecutor(1), 1, Console(quiet=True)))
    assert again.exists()


def test_submitit_makes_the_same_jobs(tmp_path):
    """Its local executor: processes as a cluster would start them, with a job's commands in their own."""
    pytest.importorskip("submitit")
    good = job(
        tmp_path,
        "good",
        f"import os; open({str(tmp_path / 'a')!r}, 'w').write(os.environ['OMP_NUM_THREADS'])",
    )
    bad = job(tmp_path, "bad", "import sys; sys.exit('the reason')")
    executor = cluster_executor("local", tmp_path / "submitted", {"timeout_min": 5})
    failures = run_jobs([good, bad], executor, 3, Console(quiet=True))
    assert (tmp_path / "a").read_text() == "3"
    assert list(failures) == ["bad"] and "the reason" in failures["bad"]


def test_unknown_settings_of_a_cluster_are_refused(tmp_path):
    pytest.importorskip("submitit")
    with pytest.raises(FlagError, match="executor_options.*partitoin"):
        cluster_executor("local", tmp_path / "submitted", {"slurm_partitoin": "gpu"})


def test_wrong_options_are_refused(tmp_path):
    with pytest.raises(FlagError, match="--jobs must be at least 1, got 0"):
        CompareConfig(matrix=tmp_path, jobs=0)


# ---- a real comparison ----

STEPS, SAVE = 30, 10


def tiny_matrix(folder: Path) -> Path:
    example = ROOT / "examples" / "fetch_pick_and_place"
    content = {
        "tasks": {
            "pick": {
                "title": "FetchPickAndPlace",
                "env": {"type": "gymnasium_robotics", "task": "FetchPickAndPlace-v4"},
                "dataset": {"repo_id": "local/pick", "root": str(example / "demonstrations")},
                "teacher": str(example / "teacher"),
            }
        },
        "methods": {
            "teacher": {"policy": "{teacher}"},
            "agpd": {},
        },
        "seeds": [3],
        "common": {
            "config_path": str(ROOT / "examples" / "presets" / "student_cpu.yaml"),
            "steps": STEPS,
            "save_freq": SAVE,
            "policy": {
                "dim_model": 32,
                "dim_feedforward": 64,
                "collect": {"warmup": 12, "every": 10, "episodes": 6, "n_envs": 3},
                "adversary.start": 5,
            },
        },
        "evaluation": {"episodes": 6, "curve_episodes": 3, "batch_size": 3},
        "output": str(folder / "comparison"),
    }
    path = folder / "matrix.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def compare(matrix: Path, *flags: str, **options) -> subprocess.Popen:
    args = [sys.executable, "-m", "lerobot_agpd.cli.compare", f"--matrix={matrix}", *flags]
    env = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "MUJOCO_GL": "egl"}
    return subprocess.Popen(
        args, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env, **options
    )


def finish(process: subprocess.Popen) -> str:
    output, _ = process.communicate(timeout=1200)
    assert process.returncode == 0, output[-5000:]
    return output


def wait_for(condition, process: subprocess.Popen | None = None, seconds: float = 900) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert process is None or process.poll() is None, "ended early"
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_a_killed_comparison_goes_on_where_it_was(tmp_path):
    matrix = tiny_matrix(tmp_path)
    output = tmp_path / "comparison" / "pick"
    agpd = output / "agpd" / "seed-3"

    first = compare(matrix, start_new_session=True)
    wait_for((agpd / "train" / "checkpoints" / "000020").exists, first)
    os.killpg(first.pid, signal.SIGKILL)  # as when the machine goes down, in the middle of the second run
    first.communicate()
    finished = output / "teacher" / "policy" / "run.json"
    made = finished.stat().st_mtime_ns
    assert not (agpd / "run.json").exists()

    shown = finish(compare(matrix))
    assert "2 runs, 1 of them finished" in shown
    assert finished.stat().st_mtime_ns == made, "a finished run is not touched"
    starts = [json.loads(line) for line in (agpd / "starts.jsonl").read_text().splitlines()]
    assert len(starts) == 2 and starts[0]["interrupted"] and "--resume=true" in starts[1]["command"]
    assert starts[1]["from_step"] in (SAVE, 2 * SAVE)
    again = CompareConfig(matrix=matrix)
    comparison, runs = load(again)
    assert not any(comparison.needs_work(run) for run in runs), "nothing is trained again"

    result = json.loads((agpd / "run.json").read_text())
    assert list(result["curve"]) == ["10", "20", "30"]
    assert [len(entry["successes"]) for entry in result["curve"].values()] == [3, 3, 3]
    assert result["curve"]["10"]["seeds"] == [500_000, 500_001, 500_002]
    assert result["last"]["step"] == STEPS and result["last"]["seeds"] == list(range(100_000, 100_006))
    assert result["best"]["step"] in (10, 20, 30) and result["config"]["steps"] == STEPS
    assert [entry["total"]["generated"] for entry in result["rounds"]] == [6, 6]
    assert result["seconds"]["total"] > result["seconds"]["environment"] > 0
    assert result["evaluated_with"]["versions"]["lerobot"]
    text = (tmp_path / "comparison" / "report.md").read_text()
    assert "| agpd | 1 of 1 | 30 |" in text and "| teacher | - | - |" in text and "Paired differences" in text
    assert (tmp_path / "comparison" / "curves-pick.png").exists()
    assert (tmp_path / "comparison" / "outcomes-pick.png").exists()
