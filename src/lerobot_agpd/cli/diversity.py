"""`lerobot-agpd-diversity`: diversity of visited states against distance from the teacher, for guidance and mixing."""

import json
import logging
from dataclasses import asdict, dataclass, field
from pathlib import Path

import draccus
import torch
from lerobot.envs import EnvConfig
from rich.console import Console

from lerobot_agpd.agpd import make_strategy
from lerobot_agpd.cli.command import StudentFlags, entry_point
from lerobot_agpd.config import EVALUATION_SEEDS, MixingForm
from lerobot_agpd.files import write_json
from lerobot_agpd.flag_checks import require
from lerobot_agpd.loading import load_pair
from lerobot_agpd.replay.episode import Episode
from lerobot_agpd.rollout.diagnostics import ObservationReservoir
from lerobot_agpd.rollout.strategies import Strategy
from lerobot_agpd.studies.frontier import plot_frontier, plot_trajectories
from lerobot_agpd.studies.sweep import Setting, Sweep, SweepRow, configured
from lerobot_agpd.studies.tables import console_table

logger = logging.getLogger(__name__)

STUDENT = Setting("interpolate", 1.0)
"""Mixing with lambda 1 is the student alone."""


@dataclass
class DiversityConfig(StudentFlags):
    """Options of `lerobot-agpd-diversity`."""

    # Folder of sweep.json, frontier.png and trajectories.png.
    output: Path
    # Scales of guidance.
    scales: list[float] = field(default_factory=lambda: [0.5, 2.0, 8.0, 32.0, 128.0])
    # Weights of mixing.
    lambdas: list[float] = field(default_factory=lambda: [0.05, 0.1, 0.2, 0.4, 0.7])
    # Forms of mixing.
    forms: list[MixingForm] = field(default_factory=lambda: ["interpolate", "switch"])
    # Episodes per setting, from the same environment seeds.
    episodes: int = 40
    # First environment seed; also seeds the noise.
    seed: int = EVALUATION_SEEDS[0] + 500_000
    # State dimensions of the trajectories' picture.
    axes: list[int] = field(default_factory=lambda: [0, 1])

    def __post_init__(self) -> None:
        """Read the checkpoint's configuration and check the options.

        Raises:
            FlagError: if there is no checkpoint, or a number is out of range.
        """
        super().__post_init__()
        require(self.episodes >= 2, f"--episodes must be at least 2, got {self.episodes}")
        require(all(scale > 0 for scale in self.scales), f"--scales must be positive, got {self.scales}")
        require(
            all(0 < weight < 1 for weight in self.lambdas),
            f"--lambdas must lie between 0 and 1, got {self.lambdas}",
        )
        require(len(self.axes) == 2, f"--axes must name two state dimensions, got {self.axes}")

    @property
    def settings(self) -> list[Setting]:
        """The teacher alone, then every strategy at every strength."""
        return [
            Setting("teacher"),
            *(Setting("guided", scale) for scale in self.scales),
            *(Setting(form, weight) for form in self.forms for weight in self.lambdas),
        ]


def sweep_settings(config: DiversityConfig) -> tuple[list[SweepRow], dict[str, list[Episode]]]:
    """Roll out and measure every setting.

    Returns:
        One row per setting, and the episodes of teacher, strongest guidance and student, for the picture.
    """
    student_config = config.student
    sampler, teacher = load_pair(student_config, config.teacher, config.env)
    seeds = range(config.seed, config.seed + config.episodes)
    sweep = Sweep(student_config, config.env, sampler.normalizer.stats, seeds, config.seed)

    def strategy(setting: Setting) -> Strategy:
        """A setting's strategy with its own source of noise."""
        generator = torch.Generator(device=student_config.device or "cpu").manual_seed(config.seed)
        return make_strategy(configured(student_config, setting), sampler.pair_with(teacher), generator)

    student = sweep.episodes(strategy(STUDENT), STUDENT)
    student_states = sweep.states(student)
    shown = {"student": student}
    rows: list[SweepRow] = []
    reservoir = ObservationReservoir(config.seed)  # of the first setting, the teacher's own decisions
    for setting in config.settings:
        episodes = sweep.episodes(strategy(setting), setting, None if rows else reservoir)
        history = reservoir.history()
        assert history is not None
        rows.append(sweep.measure(setting, strategy(setting), episodes, history, student_states))
        if setting.strategy in ("teacher", "guided"):
            shown[setting.strategy] = episodes
        logger.info("%s", json.dumps(asdict(rows[-1])))
    return rows, shown


def sweep_table(rows: list[SweepRow]) -> list[tuple[str, ...]]:
    """The sweep for the console."""
    header = ("strategy", "strength", "success", "rms to teacher", "rms to student", "entropy", "coverage")
    body = [
        (
            row.setting.strategy,
            f"{row.setting.strength:g}",
            f"{row.success:.2f}",
            f"{row.actions['rms_to_teacher']:.3f}",
            f"{row.actions['rms_to_student']:.3f}",
            "-" if row.entropy is None else f"{row.entropy:.2f}",
            f"{row.coverage:.2f}",
        )
        for row in rows
    ]
    return [header, *body]


@entry_point("lerobot-agpd-diversity")
def main(config: DiversityConfig) -> None:
    """Sweep, write and show."""
    rows, shown = sweep_settings(config)
    config.output.mkdir(parents=True, exist_ok=True)
    content = {
        "environment": draccus.encode(config.env, EnvConfig),
        "policy": str(config.student.pretrained_path),
        "first_seed": config.seed,
        "episodes": config.episodes,
        "rows": [asdict(row) for row in rows],
    }
    write_json(config.output / "sweep.json", content, indent=1)
    plot_frontier(content["rows"], config.output / "frontier.png")
    plot_trajectories(shown, (config.axes[0], config.axes[1]), config.output / "trajectories.png")
    Console().print(console_table(sweep_table(rows)))
    logger.info("numbers and pictures in %s", config.output)


if __name__ == "__main__":
    main()
