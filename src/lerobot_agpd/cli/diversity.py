"""`lerobot-agpd-diversity`: diversity of visited states against distance from the teacher, for guidance and mixing."""

import json
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import draccus
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from rich.console import Console
from rich.table import Table

from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.collect.config import EVALUATION_SEEDS
from lerobot_agpd.collect.deciders.pair import PairDecider
from lerobot_agpd.collect.strategies import make_strategy
from lerobot_agpd.collect.witness import Witness
from lerobot_agpd.distill.guided import Proposer
from lerobot_agpd.distill.loading import load_pair, require_student, student_config_from_command_line
from lerobot_agpd.files import write_json
from lerobot_agpd.guidance.config import TeacherConfig
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.studies.frontier import plot_frontier, plot_trajectories
from lerobot_agpd.studies.sweep import Setting, Sweep, SweepRow, configured

logger = logging.getLogger(__name__)

STUDENT = Setting("interpolate", 1.0)
"""Mixing with lambda 1 is the student alone."""


@dataclass
class DiversityConfig:
    """Options of `lerobot-agpd-diversity`."""

    # environment to act in
    env: EnvConfig
    # folder of sweep.json, frontier.png and trajectories.png
    output: Path
    # the student: --policy.path=<checkpoint of a distilled policy>
    policy: PreTrainedConfig | None = None
    # flags that are not set are the checkpoint's
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    # scales of guidance
    scales: list[float] = field(default_factory=lambda: [0.5, 2.0, 8.0, 32.0, 128.0])
    # weights of mixing
    lambdas: list[float] = field(default_factory=lambda: [0.05, 0.1, 0.2, 0.4, 0.7])
    # forms of mixing
    forms: list[Literal["interpolate", "switch"]] = field(default_factory=lambda: ["interpolate", "switch"])
    # episodes per setting, from the same environment seeds
    episodes: int = 40
    # first environment seed; also seeds the noise
    seed: int = EVALUATION_SEEDS[0] + 500_000
    # state dimensions of the trajectories' picture
    axes: list[int] = field(default_factory=lambda: [0, 1])

    def __post_init__(self) -> None:
        """Read the checkpoint's configuration and check the options.

        Raises:
            ValueError: if there is no checkpoint, or a number is out of range.
        """
        self.policy = require_student(student_config_from_command_line() or self.policy)
        if self.episodes < 2:
            raise ValueError(f"--episodes must be at least 2, got {self.episodes}")
        if any(scale <= 0 for scale in self.scales):
            raise ValueError(f"--scales must be positive, got {self.scales}")
        if any(not 0 < weight < 1 for weight in self.lambdas):
            raise ValueError(f"--lambdas must lie between 0 and 1, got {self.lambdas}")
        if len(self.axes) != 2:
            raise ValueError(f"--axes must name two state dimensions, got {self.axes}")

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Fields whose `.path` the parser leaves to `__post_init__`."""
        return ["policy"]

    @property
    def settings(self) -> list[Setting]:
        """The teacher alone, then every strategy at every strength."""
        return [
            Setting("teacher"),
            *(Setting("guided", scale) for scale in self.scales),
            *(Setting(form, weight) for form in self.forms for weight in self.lambdas),
        ]


def strategy(config: Any, proposer: Proposer, teacher: Teacher, setting: Setting, seed: int) -> PairDecider:
    """A setting's strategy with its own source of noise."""
    generator = torch.Generator(device=config.device).manual_seed(seed)
    return make_strategy(configured(config, setting), proposer.pair(teacher), generator)


def sweep_settings(config: DiversityConfig) -> tuple[list[SweepRow], dict[str, list[Any]]]:
    """Roll out and measure every setting.

    Returns:
        One row per setting, and the episodes of teacher, strongest guidance and student, for the picture.
    """
    policy_config: Any = config.policy
    proposer, teacher = load_pair(policy_config, config.teacher, config.env)
    seeds = range(config.seed, config.seed + config.episodes)
    sweep = Sweep(policy_config, config.env, proposer.normaliser.stats, seeds, config.seed)
    student = sweep.episodes(strategy(policy_config, proposer, teacher, STUDENT, config.seed), STUDENT)
    student_states = sweep.states(student)
    shown: dict[str, list[Any]] = {"student": student}
    rows: list[SweepRow] = []
    history: Any = None
    for setting in config.settings:
        decider = strategy(policy_config, proposer, teacher, setting, config.seed)
        watched = Witness(decider, max(policy_config.collect.diagnostics.observations, 1), config.seed)
        episodes = sweep.episodes(watched if history is None else decider, setting)
        history = history if history is not None else watched.history()  # the teacher's own decisions
        rows.append(sweep.measure(setting, decider, episodes, history, student_states))
        if setting.strategy in ("teacher", "guided"):
            shown[setting.strategy] = episodes
        logger.info("%s", json.dumps(rows[-1].to_json()))
    return rows, shown


def console_table(rows: list[SweepRow]) -> Table:
    """The sweep for the console."""
    table = Table(
        "strategy", "strength", "success", "rms to teacher", "rms to student", "entropy", "coverage"
    )
    for row in rows:
        table.add_row(
            row.setting.strategy,
            f"{row.setting.strength:g}",
            f"{row.success:.2f}",
            f"{row.actions['rms_to_teacher']:.3f}",
            f"{row.actions['rms_to_student']:.3f}",
            "-" if row.entropy is None else f"{row.entropy:.2f}",
            f"{row.coverage:.2f}",
        )
    return table


@entry_point("lerobot-agpd-diversity")
def main(config: DiversityConfig) -> None:
    """Sweep, write and show."""
    rows, shown = sweep_settings(config)
    config.output.mkdir(parents=True, exist_ok=True)
    content = {
        "environment": draccus.encode(config.env, EnvConfig),
        "policy": str(config.policy.pretrained_path) if config.policy else "",
        "first_seed": config.seed,
        "episodes": config.episodes,
        "rows": [row.to_json() for row in rows],
    }
    write_json(config.output / "sweep.json", content, indent=1)
    plot_frontier(content["rows"], config.output / "frontier.png")
    plot_trajectories(shown, (config.axes[0], config.axes[1]), config.output / "trajectories.png")
    Console().print(console_table(rows))
    logger.info("numbers and pictures in %s", config.output)


if __name__ == "__main__":
    main()
