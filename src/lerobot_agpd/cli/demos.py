"""`lerobot-agpd-demos`: successful episodes of a scripted expert as a LeRobotDataset.

With `--skill` below 1 the expert is played by an operator who hesitates, trembles, takes detours and makes mistakes
(`envs.operators`); a list of skills makes a mixture of operators. The dataset then has the feature `skill`, which no
policy reads, and `meta/demos.json` the skill of every episode.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import DONE, REWARD, SUCCESS
from rich.console import Console
from rich.table import Table

from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.cli.datasets import NewDataset, finish, write
from lerobot_agpd.config import EVALUATION_SEEDS
from lerobot_agpd.dataset_writer import DatasetWriter, flag, image, vector
from lerobot_agpd.envs.base import SingleEnvConfig
from lerobot_agpd.envs.demonstrations import SKILL, DemosReport, successful_episodes
from lerobot_agpd.envs.experts import make_expert
from lerobot_agpd.studies.statistics import success_rate

MAX_ATTEMPTS_PER_EPISODE = 10
"""Attempts per requested episode after which the command gives up."""

REPORT_PATH = Path("meta/demos.json")


@dataclass(kw_only=True)
class DemosConfig(NewDataset):
    """Options of `lerobot-agpd-demos`."""

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

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ValueError: if the task has no expert, or an option is impossible.
            FileExistsError: if `root` exists.
        """
        super().__post_init__()
        make_expert(self.env)
        if not self.skills or not all(0 <= skill <= 1 for skill in self.skills):
            raise ValueError(f"--skill={self.skill} must be one or several numbers in [0, 1].")
        if self.episodes < 1:
            raise ValueError(f"--episodes must be at least 1, got {self.episodes}.")
        if self.seed < 0 or self.seed + self.episodes > EVALUATION_SEEDS[0]:
            raise ValueError(
                f"--seed={self.seed} with --episodes={self.episodes}: the seeds of demonstrations lie in "
                f"[0, {EVALUATION_SEEDS[0]}); evaluations use those from {EVALUATION_SEEDS[0]} on."
            )

    @property
    def skills(self) -> list[float]:
        """One skill per operator."""
        return self.skill if isinstance(self.skill, list) else [self.skill]

    @property
    def seeds(self) -> range:
        """Environment seeds that may be tried: those of evaluations are out of reach."""
        end = self.seed + MAX_ATTEMPTS_PER_EPISODE * self.episodes
        return range(self.seed, min(end, EVALUATION_SEEDS[0]))


def dataset_features(config: DemosConfig) -> dict[str, dict[str, Any]]:
    """Features of a recorded frame: the environment's, reward, success, end of the episode and perhaps the skill."""
    features = {
        config.env.features_map[key]: image(tuple(feature.shape))
        if feature.type is FeatureType.VISUAL
        else vector(*feature.shape)
        for key, feature in config.env.features.items()
    }
    features |= {REWARD: vector(1), SUCCESS: flag(), DONE: flag()}
    return features if config.skills == [1.0] else features | {SKILL: vector(1)}


def record_demos(config: DemosConfig) -> DemosReport:
    """Record the dataset.

    Raises:
        ValueError: if the task has no expert.
        RuntimeError: if too few episodes succeed.
        ModuleNotFoundError: if the package of the environment is not installed.
    """
    assert isinstance(config.env, SingleEnvConfig) and config.env.fps is not None  # as all with experts
    report = DemosReport(task=str(config.env.task))
    writer = DatasetWriter(config.root, config.repo_id, config.env.fps, dataset_features(config))

    def add_report(folder: Path) -> None:
        (folder / REPORT_PATH).write_text(json.dumps(asdict(report), indent=2) + "\n")

    env = config.env.make_single()
    episodes = successful_episodes(
        env,
        make_expert(config.env),
        config.env.features_map,
        config.skills,
        config.episodes,
        config.seeds,
        report,
    )
    try:
        write(writer, episodes, config.episodes, add_report)
    finally:
        env.close()
    return report


def rate(successes: int, failures: int) -> str:
    """Fraction of successes, e.g. `0.91 [0.86, 0.94], N = 120`."""
    estimate = success_rate([True] * successes + [False] * failures)
    return f"{estimate}, N = {estimate.n}"


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
    table.add_row("recorded per attempt", rate(recorded, report.attempts - recorded))
    table.add_row("success rate without starts at the goal", rate(recorded, failed))
    operators = sorted({*report.skills, *report.failed_skills}, reverse=True)
    for skill in operators if operators != [1.0] else []:
        counts = (report.skills.count(skill), report.failed_skills.count(skill))
        table.add_row(f"  skill {skill:g}", rate(*counts))
    return table


@entry_point("lerobot-agpd-demos")
def main(config: DemosConfig) -> None:
    """Record, report and optionally upload."""
    Console().print(report_table(record_demos(config)))
    finish(LeRobotDataset(config.repo_id, root=config.root), config.push_to_hub)


if __name__ == "__main__":
    main()
