"""The YAML of a comparison: tasks, methods, training seeds and how they are evaluated."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from string import Template
from typing import Any

import draccus
import yaml
from draccus.utils import ParsingError

from lerobot_agpd.collect.config import EVALUATION_SEEDS
from lerobot_agpd.guidance.config import require

MEASURES = {"success": "successes", "max_reward": "max_rewards"}
"""What a checkpoint is judged by, and the field of an evaluation that holds it."""

LABELS = {"success": "success rate", "max_reward": "mean max reward"}
"""What tables and pictures call it."""

OWN_FLAGS = ("seed", "output_dir", "resume", "policy.teacher.path", "policy.replay.root", "env.type")
"""Flags that follow from a run's place in the matrix."""

NAME = re.compile(r"[\w.+-]+")


@dataclass
class TaskEntry:
    """What is to be learned."""

    env: dict[str, Any]  # the environment, as in --env.*
    dataset: dict[str, Any]  # the demonstrations, as in --dataset.*
    teacher: str = ""  # checkpoint of the teacher: folder or Hub repository
    flags: dict[str, Any] = field(default_factory=dict)  # flags of lerobot-train for this task
    measure: str = "success"  # what the best checkpoint is chosen by, and curves show
    title: str = ""  # as shown; default: the task's name

    def __post_init__(self) -> None:
        require(self.measure in MEASURES, f"measure must be one of {sorted(MEASURES)}, got '{self.measure}'")
        require("type" in self.env, f"env needs a type, got {self.env}")
        require(bool(self.dataset), "dataset is empty: it holds the demonstrations, as in --dataset.*")


@dataclass
class MethodEntry:
    """How it is learned: flags of lerobot-train, or a policy that is only evaluated."""

    flags: dict[str, Any] = field(default_factory=dict)  # flags of lerobot-train for this method
    policy: str = (
        ""  # a checkpoint to evaluate instead of training; '{teacher}' stands for the task's teacher
    )
    teacher: bool = True  # whether it is given the task's teacher (--policy.teacher.path)
    note: str = ""  # one line for the report: what the method is

    def __post_init__(self) -> None:
        require(
            not (self.policy and self.flags),
            f"policy '{self.policy}' is only evaluated: it takes no flags, got {self.flags}",
        )


@dataclass
class EvaluationEntry:
    """Environments of the evaluations; the same for every method."""

    episodes: int = 500  # episodes of the final evaluation of the best and of the last checkpoint
    seed: int = EVALUATION_SEEDS[0]  # their first environment seed
    curve_episodes: int = 22  # episodes at every checkpoint, for the curve and to choose the best
    curve_seed: int = 500_000  # their first environment seed
    batch_size: int = 22  # environments side by side
    device: str = "cpu"  # where policies are evaluated

    def __post_init__(self) -> None:
        for name in ("episodes", "curve_episodes"):
            require(getattr(self, name) >= 2, f"{name} must be at least 2, got {getattr(self, name)}")
        require(self.batch_size >= 1, f"batch_size must be at least 1, got {self.batch_size}")
        final = range(self.seed, self.seed + self.episodes)
        curve = range(self.curve_seed, self.curve_seed + self.curve_episodes)
        low, high = EVALUATION_SEEDS
        for name, seeds in (("seed", final), ("curve_seed", curve)):
            require(
                low <= seeds.start and seeds.stop <= high,
                f"{name}: environments {seeds.start} to {seeds.stop - 1} leave the seeds that training and collection "
                f"never use, {low} to {high - 1}",
            )
        require(
            final.stop <= curve.start or curve.stop <= final.start,
            f"the final evaluation's environments ({final.start} to {final.stop - 1}) overlap with those that choose "
            f"the best checkpoint ({curve.start} to {curve.stop - 1}); move curve_seed",
        )


@dataclass
class Matrix:
    """A comparison.

    Raises:
        ValueError: for names that cannot be folders, no or repeated seeds, unknown references, flags that the
            matrix sets itself, or a method that takes a teacher where a task has none.
    """

    tasks: dict[str, TaskEntry]
    methods: dict[str, MethodEntry]
    seeds: list[int]
    output: Path
    common: dict[str, Any] = field(default_factory=dict)
    evaluation: EvaluationEntry = field(default_factory=EvaluationEntry)
    references: list[str] = field(default_factory=list)  # methods that all are compared with; default: all

    def __post_init__(self) -> None:
        for kind, names in (("task", self.tasks), ("method", self.methods)):
            require(bool(names), f"{kind}s is empty: name at least one {kind}")
            for name in names:
                require(bool(NAME.fullmatch(name)), f"'{name}' is no name for a {kind}: it becomes a folder")
        require(
            bool(self.seeds) and len(set(self.seeds)) == len(self.seeds),
            f"seeds must be different training seeds, got {self.seeds}",
        )
        require(
            all(0 <= seed < EVALUATION_SEEDS[0] for seed in self.seeds),
            f"training seeds lie in [0, {EVALUATION_SEEDS[0]}): LeRobot's own evaluation counts up from them; got "
            f"{self.seeds}",
        )
        unknown = [name for name in self.references if name not in self.methods]
        require(not unknown, f"references {unknown} are no methods; there are {sorted(self.methods)}")
        self._check_flags()
        for task_name, task in self.tasks.items():
            for name, method in self.methods.items():
                uses = method.teacher if not method.policy else "{teacher}" in method.policy
                require(
                    bool(task.teacher) or not uses,
                    f"method '{name}' takes a teacher and tasks.{task_name} names none; set its teacher, or "
                    f"methods.{name}.teacher: false",
                )

    def _check_flags(self) -> None:
        groups = {"common": self.common}
        groups |= {f"tasks.{name}.flags": task.flags for name, task in self.tasks.items()}
        groups |= {f"methods.{name}.flags": method.flags for name, method in self.methods.items()}
        for where, group in groups.items():
            for flag in flat(group):
                require(flag not in OWN_FLAGS, f"{where} sets '{flag}', which the matrix sets itself")


def load_matrix(path: Path) -> Matrix:
    """Read a comparison; `${VARIABLE}` in its texts stands for environment variables.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming the file and the entry that is wrong.
    """
    if not path.is_file():
        raise FileNotFoundError(f"--matrix={path}: no such file")
    try:
        content = _expand(yaml.safe_load(path.read_text()))
        _known(content, Matrix)
        entries = {
            "tasks": _decode_all(content.get("tasks"), TaskEntry, "tasks"),
            "methods": _decode_all(content.get("methods"), MethodEntry, "methods"),
            "evaluation": _decode(content.get("evaluation") or {}, EvaluationEntry, "evaluation"),
        }
        seeds, common = content.get("seeds"), content.get("common") or {}
        require(
            isinstance(seeds, list) and all(type(seed) is int for seed in seeds),
            f"seeds must be a list of integers, got {seeds}",
        )
        require(isinstance(common, dict), f"common must hold flags, got {common}")
        require(bool(content.get("output")), "output is missing: the folder of the comparison")
        references = content.get("references") or []
        require(isinstance(references, list), f"references must be a list of methods, got {references}")
        output = Path(content["output"])
        return Matrix(**entries, seeds=seeds, output=output, common=common, references=references)
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(f"--matrix={path}: {error}") from error


def flat(flags: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested flags as dotted ones: `{policy: {collect: {every: 0}}}` becomes `{policy.collect.every: 0}`."""
    result: dict[str, Any] = {}
    for key, value in flags.items():
        name = f"{prefix}.{key}" if prefix else str(key)
        result |= flat(value, name) if isinstance(value, Mapping) and value else {name: value}
    return result


def _expand(value: Any) -> Any:
    if isinstance(value, str):
        try:
            return Template(value).substitute(os.environ)
        except KeyError as error:
            raise ValueError(
                f"'{value}' uses ${{{error.args[0]}}}, which is not in the environment"
            ) from error
    if isinstance(value, dict):
        return {key: _expand(entry) for key, entry in value.items()}
    return [_expand(entry) for entry in value] if isinstance(value, list) else value


def _decode_all(entries: Any, kind: type, where: str) -> dict[str, Any]:
    require(isinstance(entries, dict), f"{where} must name its entries, got {entries}")
    return {str(name): _decode(entry or {}, kind, f"{where}.{name}") for name, entry in entries.items()}


def _decode(entry: Any, kind: type, where: str) -> Any:
    try:
        _known(entry, kind)
        return draccus.decode(kind, entry)
    except (ValueError, ParsingError) as error:
        raise ValueError(f"{where}: {reason(error)}") from error


def reason(error: BaseException) -> str:
    """What is wrong with an entry, with the first cause: draccus hides what a `__post_init__` says."""
    first = error
    while first.__cause__ is not None:
        first = first.__cause__
    text = str(error) if first is error else f"{error} {first}"
    return " ".join(text.split())


def _known(entry: Any, kind: type) -> None:
    names = [field_.name for field_ in fields(kind)]
    require(isinstance(entry, dict), f"expected entries {names}, got {entry}")
    unknown = sorted(set(map(str, entry)) - set(names))
    require(not unknown, f"unknown entries {unknown}; there are {names}")
