"""Tiny `lerobot-train` runs in the point environment of tests/plugins, forked from a process that has imported everything."""

# ruff: noqa: E402  # the plugin of the tests must be found first

import functools
import json
import os
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")
TESTS = Path(__file__).parents[1] / "tests"
sys.path[:0] = [str(TESTS / "plugins"), str(TESTS / "e2e")]

import draccus
import lerobot_env_point  # noqa: F401
import torch
from commands import TINY_STUDENT, TINY_TEACHER, dataset_flags
from draccus.wrappers import docstring
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts import lerobot_train
from point import make_demonstrations

from lerobot_agpd import plugin

EPISODES, ROUNDS, STEPS = 4, 2, 6
RUN = [
    *TINY_STUDENT,
    "--env.type=point",
    "--policy.collect.warmup=2",
    "--policy.collect.every=2",
    f"--policy.collect.episodes={EPISODES}",
    "--policy.collect.n_envs=2",
    "--policy.adversary.start=1",
    f"--steps={STEPS}",
    "--save_freq=3",
]
"""Six steps, two rounds of four episodes, a checkpoint after step 3."""

TIMEOUT = 900
"""Seconds after which a run that has not ended is killed."""

Inside = Callable[[int], AbstractContextManager[None]]
"""What a process of a run does around `lerobot-train`; it is called with the process's rank."""


def prepare(folder: Path) -> list[str]:
    """Flags of the runs, with demonstrations and a teacher that are made here."""
    torch.set_num_threads(1)
    # Half of a tiny run's time goes into the help texts of flags that nobody reads; they are looked up once, here.
    docstring.get_attribute_docstring = functools.cache(docstring.get_attribute_docstring)
    isolated(lambda: str(make_demonstrations(folder / "demos")))
    dataset, teacher = dataset_flags(folder / "demos"), folder / "teacher"
    draccus.parse(TrainPipelineConfig, args=[*RUN, *dataset])
    codes = train([*TINY_TEACHER, *dataset, "--steps=150", f"--output_dir={teacher}"], folder / "log")
    assert codes == [0], (folder / "log" / "rank-0.log").read_text()[-2000:]
    path = teacher / "checkpoints" / "last" / "pretrained_model"
    return [*RUN, *dataset, f"--policy.teacher.path={path}"]


def train(
    flags: list[str],
    folder: Path,
    n_ranks: int = 1,
    inside: Inside | None = None,
    seconds: float | None = None,
) -> list[int]:
    """Run `lerobot-train` to its end, or until it is killed.

    Args:
        flags: of `lerobot-train`.
        folder: takes a log of every process, `rank-<n>.log`.
        n_ranks: number of processes; where one fails the others are killed, as a launcher does.
        inside: entered by every process.
        seconds: after which all processes are killed.

    Returns:
        The exit codes, in the order in which the processes ended.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    folder.mkdir(parents=True, exist_ok=True)
    running = {_fork(flags, folder, rank, n_ranks, port, inside) for rank in range(n_ranks)}
    began, codes, limit = time.monotonic(), [], TIMEOUT if seconds is None else seconds
    while running:
        process, status = os.waitpid(-1, os.WNOHANG)
        if process:
            running.discard(process)
            codes.append(os.waitstatus_to_exitcode(status))
        if (process and codes[-1]) or time.monotonic() - began > limit:
            limit = TIMEOUT
            for other in running:
                os.kill(other, signal.SIGKILL)
        time.sleep(0.01)
    return codes


def _fork(flags: list[str], folder: Path, rank: int, n_ranks: int, port: int, inside: Inside | None) -> int:
    """Run `lerobot-train` in a fork of this process; returns its id."""
    process = os.fork()
    if process:
        return process
    os.setpgid(0, 0)
    status = 1
    try:
        with (folder / f"rank-{rank}.log").open("wb") as file:
            os.dup2(file.fileno(), 1), os.dup2(file.fileno(), 2)
        if n_ranks > 1:
            ranks = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": n_ranks, "LOCAL_WORLD_SIZE": n_ranks}
            os.environ |= {name: str(value) for name, value in ranks.items()}
            os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        sys.argv = ["lerobot-train", *flags]
        plugin.warn_of_refused_command()  # as where a process of its own imports the plugin
        with inside(rank) if inside else nullcontext():
            lerobot_train.main()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
        sys.stderr.write(f"{end.code}\n" if isinstance(end.code, str) else "")
    except BaseException:
        sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]  # which a run may have exchanged
    finally:
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(status)


def isolated(function: Callable[[], object]) -> object:
    """Call a function in a fork, since datasets start threads that must not be forked; returns its JSON result."""
    reading, writing = os.pipe()
    process = os.fork()
    if not process:
        try:
            os.write(writing, json.dumps(function()).encode())
        except BaseException:
            os.write(writing, json.dumps([f"check failed: {traceback.format_exc()[-600:]}"]).encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as file:
        content = file.read()
    os.waitpid(process, 0)
    return json.loads(content)
