"""`lerobot-agpd-report`: evaluate runs side by side; a table, a picture and JSON."""

import json
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
from lerobot.envs import EnvConfig
from rich.console import Console
from rich.table import Table

from lerobot_agpd.analysis.evaluation import (
    Checkpoint,
    Environments,
    checkpoint_config,
    checkpoint_steps,
)
from lerobot_agpd.analysis.report import HEADER, MethodResult, markdown, plot_curves, table_rows
from lerobot_agpd.analysis.statistics import success_rate
from lerobot_agpd.cli.command import command
from lerobot_agpd.collect.config import EVALUATION_SEEDS
from lerobot_agpd.guidance.config import require
from lerobot_agpd.replay.store import ReplayStore

logger = logging.getLogger(__name__)


@dataclass
class ReportConfig:
    """Options of `lerobot-agpd-report`."""

    env: EnvConfig  # environment to evaluate in
    output: Path  # folder of report.json, report.md and curves.png
    runs: dict[str, Path] = field(default_factory=dict)  # name to output folder of a lerobot-train run
    policies: dict[str, Path] = field(
        default_factory=dict
    )  # name to a single checkpoint, such as the teacher
    episodes: int = 200  # episodes of the final evaluation
    curve_episodes: int = 0  # episodes at every earlier checkpoint; 0: no learning curve
    n_action_steps: list[int] = field(
        default_factory=list
    )  # steps executed per prediction, e.g. "[8,2]": one row each; default: the checkpoint's
    batch_size: int = 50  # environments side by side
    seed: int = 100_000  # first environment seed; training and collection stay away from 100000 to 999999
    device: str = "cpu"  # where policies run
    title: str = ""  # title of the picture

    def __post_init__(self) -> None:
        if not self.runs and not self.policies:
            raise ValueError("nothing to report: name runs (--runs='{name: folder}') or --policies")
        for name, path in {**self.runs, **self.policies}.items():
            if not Path(path).exists():
                raise FileNotFoundError(f"'{name}': {path} does not exist")
        require(self.episodes >= 2, f"--episodes must be at least 2, got {self.episodes}")
        require(
            self.curve_episodes == 0 or self.curve_episodes >= 2,
            f"--curve_episodes must be 0 or at least 2, got {self.curve_episodes}",
        )
        require(self.batch_size >= 1, f"--batch_size must be at least 1, got {self.batch_size}")
        low, high = EVALUATION_SEEDS
        require(
            low <= self.seed and self.seed + max(self.episodes, self.curve_episodes) <= high,
            f"--seed={self.seed}: environments of an evaluation lie in [{low}, {high}), which training and collection "
            "never use",
        )
        for path in (*self.policies.values(), *(last_checkpoint(run) for run in self.runs.values())):
            for n_steps in self.n_action_steps:
                checkpoint_config(path, n_steps)

    @property
    def replanning(self) -> list[int | None]:
        """Steps executed per prediction, one row each; None is the checkpoint's own number."""
        return [*self.n_action_steps] or [None]


def last_checkpoint(run: Path) -> Path:
    """The policy of a run's last checkpoint."""
    steps = checkpoint_steps(run)
    return steps[max(steps)]


def evaluate_run(
    name: str, run: Path, environments: Environments, config: ReportConfig
) -> list[MethodResult]:
    """Evaluate a run's last checkpoint, and the earlier ones for its learning curve."""
    steps = checkpoint_steps(run)
    last = max(steps)
    curve = {}
    for step, path in steps.items():
        if config.curve_episodes and step != last:
            checkpoint = Checkpoint(path, config.device, config.replanning[0])
            curve[step] = checkpoint.evaluate(environments, config.curve_episodes, config.seed)
            logger.info("evaluated %s at step %d: %s", name, step, success_rate(curve[step].successes))
    results = evaluate_policy(name, steps[last], environments, config)
    if curve:
        results[0].curve = {**curve, last: results[0].final}
    rounds = ReplayStore(run / "agpd").reports()
    if rounds:
        keys = ("generated", "successful", "kept")
        results[0].collection = {key: sum(entry[key] for entry in rounds) for key in keys} | {
            "rounds": rounds
        }
    return results


def evaluate_policy(
    name: str, path: Path, environments: Environments, config: ReportConfig
) -> list[MethodResult]:
    """Evaluate one checkpoint, once for every number of steps that it shall execute per prediction."""
    results = []
    for n_steps in config.replanning:
        checkpoint = Checkpoint(path, config.device, n_steps)
        final = checkpoint.evaluate(environments, config.episodes, config.seed)
        row = name if n_steps is None else f"{name}, {n_steps} step{'s' * (n_steps != 1)} per chunk"
        logger.info("evaluated %s: success %s", row, success_rate(final.successes))
        results.append(MethodResult(row, final, checkpoint.latency()))
    return results


def show(results: list[MethodResult]) -> None:
    """Print the table."""
    table = Table(*HEADER)
    for row in table_rows(results):
        table.add_row(*row)
    Console().print(table)


def write(results: list[MethodResult], config: ReportConfig) -> None:
    """Write what is known so far."""
    content = {
        "environment": draccus.encode(config.env, EnvConfig),
        "first_seed": config.seed,
        "methods": [result.to_json() for result in results],
    }
    (config.output / "report.json").write_text(json.dumps(content, default=str) + "\n")
    (config.output / "report.md").write_text(markdown(results))


@draccus.wrap()
def run(config: ReportConfig) -> None:
    """Evaluate, write and show."""
    config.output.mkdir(parents=True, exist_ok=True)
    results: list[MethodResult] = []
    with Environments(config.env, min(config.batch_size, config.episodes)) as environments:
        for entries, evaluate in ((config.policies, evaluate_policy), (config.runs, evaluate_run)):
            for name, path in entries.items():
                results += evaluate(name, path, environments, config)
                write(results, config)
    rounds: list[dict[str, Any]] = next(
        (result.collection["rounds"] for result in results if result.collection), []
    )
    plot_curves(results, rounds, config.output / "curves.png", config.title)
    show(results)
    logger.info("wrote report.json, report.md and curves.png to %s", config.output)


def main() -> None:
    """Console entry point."""
    with command("lerobot-agpd-report"):
        run()


if __name__ == "__main__":
    main()
