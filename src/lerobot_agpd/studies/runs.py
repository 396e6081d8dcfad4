"""The runs of a comparison: one ordinary `lerobot-train` command per task, method and training seed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_agpd.flag_checks import FlagError, require
from lerobot_agpd.studies.matrix import Matrix, TaskEntry, flat
from lerobot_agpd.studies.parsing import decode_environment, parse_train_flags


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
    def args(self) -> list[str]:
        """The flags as command-line arguments, without the output folder."""
        return [
            f"--{name}={value if isinstance(value, str) else json.dumps(value)}"
            for name, value in self.flags.items()
        ]


def expand(
    matrix: Matrix,
    tasks: Sequence[str] = (),
    methods: Sequence[str] = (),
    seeds: Sequence[int] = (),
) -> list[Run]:
    """List the runs of a matrix, or of the named part of it, one training seed after the other.

    Raises:
        ValueError: for a name or seed that the matrix does not have.
    """
    for flag, requested, present in (
        ("tasks", tasks, list(matrix.tasks)),
        ("methods", methods, list(matrix.methods)),
        ("seeds", seeds, matrix.seeds),
    ):
        unknown = [entry for entry in requested if entry not in present]
        require(not unknown, f"--{flag}: the matrix has no {unknown}; there are {present}")
    cells = [(task, method) for task in tasks or matrix.tasks for method in methods or matrix.methods]
    runs = []
    for number, seed in enumerate(seeds or matrix.seeds):
        for task, method in cells:
            if not matrix.methods[method].policy:
                runs.append(_trained(matrix, task, method, seed))
            elif number == 0:
                runs.append(_evaluated(matrix, task, method))
    return runs


def _trained(matrix: Matrix, task_name: str, method_name: str, seed: int) -> Run:
    task, method = matrix.tasks[task_name], matrix.methods[method_name]
    flags = flat(matrix.common) | flat({"dataset": task.dataset, "env": task.env}) | flat(task.flags)
    if method.teacher:
        flags["policy.teacher.path"] = task.teacher
    flags |= {name: _fill_in(value, task) for name, value in flat(method.flags).items()}
    flags["seed"] = seed
    return Run(task_name, method_name, seed, matrix.output / task_name / method_name / f"seed-{seed}", flags)


def _evaluated(matrix: Matrix, task_name: str, method_name: str) -> Run:
    task = matrix.tasks[task_name]
    policy = _fill_in(matrix.methods[method_name].policy, task)
    flags = {"policy.path": policy, **flat({"env": task.env})}
    return Run(
        task_name, method_name, None, matrix.output / task_name / method_name / "policy", flags, policy
    )


def _fill_in(value: Any, task: TaskEntry) -> Any:
    return value.replace("{teacher}", task.teacher) if isinstance(value, str) else value


def check(matrix: Matrix, runs: Sequence[Run]) -> None:
    """Parse every command as lerobot-train would, and look for the files that it names.

    Raises:
        ValueError: naming task and method of the first command that cannot work.
    """
    for run in {(run.task, run.method): run for run in reversed(runs)}.values():
        try:
            decode_environment(matrix.tasks[run.task].env)
            missing = _missing(run)
            require(not missing, f"{', '.join(missing)} does not exist")
            if not run.policy:
                _check_flags(run)
        except (ValueError, FlagError) as error:
            raise ValueError(f"task '{run.task}', method '{run.method}': {error}") from error


def _check_flags(run: Run) -> None:
    """Refuse a flag or value that LeRobot refuses, or one that a comparison cannot have."""
    config = parse_train_flags(run.args)
    require(
        not getattr(config.policy, "push_to_hub", False),
        "policy.push_to_hub is on: a comparison does not upload its runs; set it to false in common",
    )
    require(config.save_checkpoint, "save_checkpoint is off: a run without checkpoints cannot be evaluated")


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
