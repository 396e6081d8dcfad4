"""The YAML of a comparison: tasks, methods, training seeds and how they are evaluated."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from string import Template
from typing import Any, Literal

import draccus
import yaml
from draccus.utils import ParsingError

from lerobot_agpd.config import EVALUATION_SEEDS
from lerobot_agpd.flag_checks import require
from lerobot_agpd.studies.parsing import reason

LABELS = {"success": "success rate", "max_reward": "mean max reward"}
"""Measures of a checkpoint, as tables and pictures show them."""

OWN_FLAGS = ("seed", "output_dir", "resume", "policy.teacher.path", "policy.replay.root", "env.type")
"""Flags that follow from a run's place in the matrix."""

NAME = re.compile(r"[\w.+-]+")

Measure = Literal["success", "max_reward"]


@dataclass
class TaskEntry:
    """What is to be learned."""

    # Environment, as in --env.*; `discover_packages_path` names a package that registers its type.
    env: dict[str, Any]
    # Demonstrations, as in --dataset.*.
    dataset: dict[str, Any]
    # Checkpoint of the teacher: folder or Hub repository.
    teacher: str = ""
    # Flags of lerobot-train for this task.
    flags: dict[str, Any] = field(default_factory=dict)
    # What the best checkpoint is chosen by, and curves show.
    measure: Measure = "success"
    # As shown; default: the task's name.
    title: str = ""

    def __post_init__(self) -> None:
        require("type" in self.env, f"env needs a type, got {self.env}")
        require(bool(self.dataset), "dataset is empty: it holds the demonstrations, as in --dataset.*")


@dataclass
class MethodEntry:
    """How it is learned: flags of lerobot-train, or a policy that is only evaluated."""

    # Flags of lerobot-train for this method.
    flags: dict[str, Any] = field(default_factory=dict)
    # A checkpoint to evaluate instead of training; '{teacher}' stands for the task's teacher.
    policy: str = ""
    # Whether it is given the task's teacher (--policy.teacher.path).
    teacher: bool = True
    # One line for the report: what the method is.
    note: str = ""

    def __post_init__(self) -> None:
        require(
            not (self.policy and self.flags),
            f"policy '{self.policy}' is only evaluated: it takes no flags, got {self.flags}",
        )

    @property
    def takes_teacher(self) -> bool:
        """Whether it needs a task that has a teacher."""
        return "{teacher}" in self.policy if self.policy else self.teacher


@dataclass
class EvaluationEntry:
    """Environments of the evaluations; the same for every method."""

    # Episodes of the final evaluation of the best and of the last checkpoint.
    episodes: int = 500
    # Their first environment seed.
    seed: int = EVALUATION_SEEDS[0]
    # Episodes at every checkpoint, for the curve and to choose the best.
    curve_episodes: int = 22
    # Their first environment seed.
    curve_seed: int = 500_000
    # Environments side by side.
    batch_size: int = 22
    # Where policies are evaluated.
    device: str = "cpu"

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
    # Training seeds.
    seeds: list[int]
    # Folder of the runs and the report.
    output: Path
    # Flags of lerobot-train for all runs.
    common: dict[str, Any] = field(default_factory=dict)
    evaluation: EvaluationEntry = field(default_factory=EvaluationEntry)
    # Methods that all are compared with; default: all.
    references: list[str] = field(default_factory=list)

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
                require(
                    bool(task.teacher) or not method.takes_teacher,
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
    """Read a comparison; `${VARIABLE}` in the file stands for an environment variable.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming the file and the entry that is wrong.
    """
    if not path.is_file():
        raise FileNotFoundError(f"--matrix={path}: no such file")
    try:
        text = Template(path.read_text()).substitute(os.environ)
    except KeyError as error:
        raise ValueError(
            f"--matrix={path} uses ${{{error.args[0]}}}, which is not in the environment"
        ) from error
    try:
        content = yaml.safe_load(text)
        require(isinstance(content, dict), f"expected tasks, methods, seeds and output, got {content}")
        return draccus.decode(Matrix, content)
    except (ValueError, ParsingError, yaml.YAMLError) as error:
        raise ValueError(f"--matrix={path}: {reason(error)}") from error


def flat(flags: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested flags: `{policy: {collect: {every: 0}}}` becomes `{policy.collect.every: 0}`."""
    result: dict[str, Any] = {}
    for key, value in flags.items():
        name = f"{prefix}.{key}" if prefix else str(key)
        result |= flat(value, name) if isinstance(value, Mapping) and value else {name: value}
    return result
