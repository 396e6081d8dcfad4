"""`lerobot-agpd-demos`: successful episodes of a scripted expert as a LeRobotDataset.

With `--skill` below 1 the expert is played by an operator who hesitates, trembles, takes detours and makes mistakes
(`envs.operators`); a list of skills makes a mixture of operators. The dataset then has the feature `skill`, which no
policy reads, and `meta/demos.json` the skill of every episode.
"""

import json
import logging
from dataclasses import asdict, dataclass, field
from pathlib import Path

from datasets import disable_progress_bars
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from rich.console import Console
from rich.table import Table
from scipy.stats import binomtest

from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.cli.progress import episode_bar
from lerobot_agpd.config import EVALUATION_SEEDS
from lerobot_agpd.dataset_writer import DatasetWriter, vector
from lerobot_agpd.envs.base import SimulatedEnvConfig
from lerobot_agpd.envs.demonstrations import SKILL, DemosReport, dataset_features, successful_episodes
from lerobot_agpd.envs.experts import make_expert
from lerobot_agpd.envs.experts.base import Expert
from lerobot_agpd.envs.experts.ways import WaysExpert
from lerobot_agpd.flag_checks import FlagError, require

logger = logging.getLogger(__name__)

MAX_ATTEMPTS_PER_EPISODE = 10
"""Attempts per requested episode after which the command gives up."""

REPORT_PATH = Path("meta/demos.json")


@dataclass
class DemosConfig:
    """Options of `lerobot-agpd-demos`."""

    # Folder of the new dataset; must not exist.
    root: Path
    # Environment, whose task needs a scripted expert.
    env: EnvConfig = field(default_factory=lambda: EnvConfig.get_choice_class("gymnasium_robotics")())
    # Name of the new dataset.
    repo_id: str = "local/demos"
    # Successful episodes to record.
    episodes: int = 50
    # Attempt i starts from environment seed `seed + i`.
    seed: int = 0
    # 1 is the expert, 0 the worst operator; "[1,0.5]": two operators in turn.
    skill: float | list[float] = 1.0
    # Tasks with several ways only: fraction of the episodes on each way, e.g. "[0.25,0.25,0.5]"; default: all alike.
    ways: list[float] | None = None
    # Upload the dataset when it is done.
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            FlagError: if an option is impossible.
            ValueError: if the task has no expert.
        """
        self.make_expert()
        require(
            bool(self.skills) and all(0 <= skill <= 1 for skill in self.skills),
            f"--skill={self.skill} must be one or several numbers in [0, 1]",
        )
        require(self.episodes >= 1, f"--episodes must be at least 1, got {self.episodes}")
        require(
            0 <= self.seed <= EVALUATION_SEEDS[0] - self.episodes,
            f"--seed={self.seed} with --episodes={self.episodes}: the seeds of demonstrations lie in "
            f"[0, {EVALUATION_SEEDS[0]}); evaluations use those from {EVALUATION_SEEDS[0]} on",
        )
        require(not self.root.exists(), f"--root={self.root} already exists; choose a new folder")

    def make_expert(self) -> Expert | WaysExpert:
        """Expert of the task, with the requested fractions of the ways.

        Raises:
            FlagError: if the task does not have these ways.
            ValueError: if the task has no expert.
        """
        expert = make_expert(self.env)
        if self.ways is None:
            return expert
        if not isinstance(expert, WaysExpert):
            raise FlagError(f"--ways={self.ways}: the expert of --env.task={self.env.task} knows one way")
        return expert.with_ways(self.ways)

    @property
    def skills(self) -> list[float]:
        """One skill per operator."""
        return self.skill if isinstance(self.skill, list) else [self.skill]

    @property
    def seeds(self) -> range:
        """Environment seeds that may be tried: those of evaluations are out of reach."""
        end = self.seed + MAX_ATTEMPTS_PER_EPISODE * self.episodes
        return range(self.seed, min(end, EVALUATION_SEEDS[0]))


def record_demos(config: DemosConfig) -> DemosReport:
    """Record the dataset.

    Raises:
        ValueError: if the task has no expert.
        RuntimeError: if too few episodes succeed.
        ModuleNotFoundError: if the package of the environment is not installed.
    """
    assert isinstance(config.env, SimulatedEnvConfig) and config.env.fps is not None  # as all with experts
    report = DemosReport(task=str(config.env.task))
    features = dataset_features(config.env)
    if config.skills != [1.0]:
        features[SKILL] = vector(1)
    writer = DatasetWriter(config.root, config.repo_id, config.env.fps, features)

    def add_report(folder: Path) -> None:
        (folder / REPORT_PATH).write_text(json.dumps(asdict(report), indent=2) + "\n")

    env = config.env.build()
    episodes = successful_episodes(
        env,
        config.make_expert(),
        config.env.features_map,
        config.skills,
        config.episodes,
        config.seeds,
        report,
    )
    try:
        with episode_bar(report.task, config.episodes) as advance:
            writer.write(episodes, lambda: advance(1), add_report)
    finally:
        env.close()
    return report


def success_rate(successes: int, failures: int) -> str:
    """Fraction of successes with Wilson's 95 % interval, e.g. `0.91 [0.86, 0.94], N = 120`."""
    n = successes + failures
    interval = binomtest(successes, n).proportion_ci(method="wilson")
    return f"{successes / n:.2f} [{interval.low:.2f}, {interval.high:.2f}], N = {n}"


def report_table(report: DemosReport) -> Table:
    """Lay the counts out for the console.

    Episodes are played until enough succeed, so the last one always does; over few episodes that flatters the rates.
    """
    recorded, failed = len(report.seeds), len(report.failed_seeds)
    table = Table("scripted expert", report.task)
    table.add_row("attempts", str(report.attempts))
    table.add_row("skipped: goal reached at the start", str(len(report.solved_at_start_seeds)))
    table.add_row("dropped: failed", str(failed))
    table.add_row("recorded episodes", str(recorded))
    table.add_row("recorded frames", str(report.frames))
    table.add_row("recorded per attempt", success_rate(recorded, report.attempts - recorded))
    table.add_row("success rate without starts at the goal", success_rate(recorded, failed))
    operators = sorted({*report.skills, *report.failed_skills}, reverse=True)
    for skill in operators if operators != [1.0] else []:
        rate = success_rate(report.skills.count(skill), report.failed_skills.count(skill))
        table.add_row(f"  skill {skill:g}", rate)
    return table


@entry_point("lerobot-agpd-demos")
def main(config: DemosConfig) -> None:
    """Record, report and optionally upload."""
    disable_progress_bars()  # one bar of the datasets library per episode would tear ours apart
    report = record_demos(config)
    Console().print(report_table(report))
    logger.info("%d episodes, %d frames in %s", len(report.seeds), report.frames, config.root)
    if config.push_to_hub:
        LeRobotDataset(config.repo_id, root=config.root).push_to_hub()


if __name__ == "__main__":
    main()
