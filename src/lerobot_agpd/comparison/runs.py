"""The runs of a comparison: one ordinary `lerobot-train` command per task, method and training seed."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
from draccus.utils import ParsingError
from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs import EnvConfig

from lerobot_agpd.comparison.matrix import Matrix, MethodEntry, TaskEntry, flat, reason
from lerobot_agpd.guidance.config import require


@dataclass(frozen=True)
class Run:
    """One cell of the matrix.

    Attributes:
        task: its name.
        method: its name.
        seed: training seed; None for a policy that is only evaluated.
        folder: where everything of it lives.
        flags: dotted flags of lerobot-train; of lerobot-eval if only evaluated.
        policy: checkpoint that is only evaluated; empty if trained.
    """

    task: str
    method: str
    seed: int | None
    folder: Path
    flags: Mapping[str, Any]
    policy: str = ""

    @property
    def name(self) -> str:
        """E.g. `pusht/agpd/seed-1`."""
        return "/".join(self.folder.parts[-3:])

    @property
    def output_dir(self) -> Path:
        """The folder that lerobot-train writes."""
        return self.folder / "train"

    @property
    def words(self) -> list[str]:
        """The flags as words of a command line, without the output folder."""
        return [f"--{name}={_text(value)}" for name, value in self.flags.items()]


def expand(
    matrix: Matrix,
    tasks: Sequence[str] = (),
    methods: Sequence[str] = (),
    seeds: Sequence[int] = (),
) -> list[Run]:
    """The runs of a matrix, or of the named part of it, one training seed after the other.

    Raises:
        ValueError: for a name or seed that the matrix does not have.
    """
    for flag, wanted, known in (
        ("tasks", tasks, list(matrix.tasks)),
        ("methods", methods, list(matrix.methods)),
        ("seeds", seeds, matrix.seeds),
    ):
        unknown = [entry for entry in wanted if entry not in known]
        require(not unknown, f"--{flag}: the matrix has no {unknown}; there are {known}")
    chosen_methods = {name: matrix.methods[name] for name in methods or matrix.methods}
    runs = []
    for number, seed in enumerate(seeds or matrix.seeds):
        for task in tasks or matrix.tasks:
            for name, method in chosen_methods.items():
                if not method.policy:
                    runs.append(_trained(matrix, task, name, seed))
                elif number == 0:
                    runs.append(_evaluated(matrix, task, name))
    return runs


def _trained(matrix: Matrix, task_name: str, method_name: str, seed: int) -> Run:
    task, method = matrix.tasks[task_name], matrix.methods[method_name]
    flags = {**flat(matrix.common), **flat({"dataset": task.dataset, "env": task.env}), **flat(task.flags)}
    if method.teacher:
        flags["policy.teacher.path"] = task.teacher
    flags |= _with_teacher(flat(method.flags), task)
    flags["seed"] = seed
    return Run(task_name, method_name, seed, matrix.output / task_name / method_name / f"seed-{seed}", flags)


def _evaluated(matrix: Matrix, task_name: str, method_name: str) -> Run:
    task, method = matrix.tasks[task_name], matrix.methods[method_name]
    folder, policy = matrix.output / task_name / method_name / "policy", _policy(method, task)
    return Run(
        task_name, method_name, None, folder, {"policy.path": policy, **flat({"env": task.env})}, policy
    )


def _policy(method: MethodEntry, task: TaskEntry) -> str:
    return method.policy.replace("{teacher}", task.teacher)


def _with_teacher(flags: Mapping[str, Any], task: TaskEntry) -> dict[str, Any]:
    return {
        name: value.replace("{teacher}", task.teacher) if isinstance(value, str) else value
        for name, value in flags.items()
    }


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


# ---- checks before anything starts ----


def check(matrix: Matrix, runs: Sequence[Run]) -> None:
    """Parse every command as lerobot-train would, and look for the files that it names.

    Raises:
        ValueError: naming task and method of the first command that cannot work.
    """
    checked = set()
    for run in runs:
        if (run.task, run.method) in checked:
            continue
        checked.add((run.task, run.method))
        try:
            environment(matrix.tasks[run.task])
            missing = _missing(run)
            require(not missing, f"{', '.join(missing)} does not exist")
            if not run.policy:
                parse_flags(run.words)
        except ValueError as error:
            raise ValueError(f"task '{run.task}', method '{run.method}': {error}") from error


def environment(task: TaskEntry) -> EnvConfig:
    """The environment of a task.

    Raises:
        ValueError: for an unknown type or field.
    """
    try:
        return draccus.decode(EnvConfig, dict(task.env))
    except ParsingError as error:
        raise ValueError(f"env: {reason(error)}") from error


def _missing(run: Run) -> list[str]:
    """Files that a run names and that do not exist; a policy may also be a Hub repository `owner/name`."""
    files = {name: run.flags.get(name) for name in ("dataset.root", "config_path")}
    policies = {"policy": run.policy, "policy.teacher.path": run.flags.get("policy.teacher.path")}
    missing = [f"{name} '{path}'" for name, path in files.items() if path and not Path(path).exists()]
    for name, path in policies.items():
        could_be_hub = path and path.count("/") == 1 and path[0] not in "./~"
        if path and not could_be_hub and not Path(path).exists():
            missing.append(f"{name} '{path}'")
    return missing


def parse_flags(words: Sequence[str]) -> TrainPipelineConfig:
    """Parse flags with LeRobot's own configuration.

    Returns:
        What lerobot-train makes of them, defaults included.

    Raises:
        ValueError: for a flag or value that it refuses, or one that a comparison cannot have.
    """
    config_path = parser.parse_arg("config_path", words)
    words = parser.filter_path_args(["policy", "reward_model"], parser.filter_arg("config_path", words))
    printed, disabled = io.StringIO(), logging.root.manager.disable
    logging.disable(logging.WARNING)  # what LeRobot warns of while parsing, the run says again
    try:
        with redirect_stderr(printed):
            config: TrainPipelineConfig = draccus.parse(
                TrainPipelineConfig, config_path=config_path, args=words
            )
    except SystemExit as error:
        raise ValueError(printed.getvalue().rpartition("error: ")[2].strip()) from error
    except (ParsingError, OSError) as error:
        raise ValueError(reason(error)) from error
    finally:
        logging.disable(disabled)
    require(
        not getattr(config.policy, "push_to_hub", False),
        "policy.push_to_hub is on: a comparison does not upload its runs; set it to false in common",
    )
    require(config.save_checkpoint, "save_checkpoint is off: a run without checkpoints cannot be evaluated")
    return config
