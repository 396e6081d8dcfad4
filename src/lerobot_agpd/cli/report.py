"""`lerobot-agpd-report`: evaluate runs side by side; a table, a picture, JSON and a page to look at."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import draccus
from lerobot.envs import EnvConfig
from rich.console import Console

from lerobot_agpd.cards.model_card import add_results, environment_flags
from lerobot_agpd.cli.command import entry_point, machine_device
from lerobot_agpd.config import EVALUATION_SEEDS
from lerobot_agpd.flag_checks import require
from lerobot_agpd.progress import REPLAY_FOLDER
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.rollout.report import read_reports
from lerobot_agpd.studies.contact_sheet import draw_contact_sheet
from lerobot_agpd.studies.curves import draw_report_curves
from lerobot_agpd.studies.evaluation import Evaluator, checkpoint_config, checkpoint_steps
from lerobot_agpd.studies.page import RunPart, write_page
from lerobot_agpd.studies.report import write_summary
from lerobot_agpd.studies.results import Result, pooled
from lerobot_agpd.studies.tables import (
    console_table,
    markdown,
    round_ways_table,
    rounds_table,
    summary_table,
)
from lerobot_agpd.studies.ways import ways_of_rounds

logger = logging.getLogger(__name__)


@dataclass
class ReportConfig:
    """Options of `lerobot-agpd-report`."""

    # Environment to evaluate in.
    env: EnvConfig
    # Folder of report.html, report.json, report.md, curves.png and the single evaluations, which a second call reuses.
    output: Path
    # Name to output folder of a lerobot-train run.
    runs: dict[str, Path] = field(default_factory=dict)
    # Name to a single checkpoint, such as the teacher.
    policies: dict[str, Path] = field(default_factory=dict)
    # Episodes of the final evaluation.
    episodes: int = 200
    # Episodes at every earlier checkpoint; 0: no learning curve.
    curve_episodes: int = 0
    # Steps executed per prediction, e.g. "[8,2]": one row each; default: the checkpoint's.
    n_action_steps: list[int] = field(default_factory=list)
    # Environments side by side.
    batch_size: int = 50
    # First environment seed; training and collection stay away from 100000 to 999999.
    seed: int = EVALUATION_SEEDS[0]
    # Where policies run; default: this machine's accelerator, else the CPU.
    device: str = ""
    # Title of picture and page.
    title: str = ""
    # Further pictures or films to show on the page.
    pictures: list[Path] = field(default_factory=list)
    # Episodes of every run's last round to show on a contact sheet, which renders them again; 0: no sheet.
    sheet_episodes: int = 0

    def __post_init__(self) -> None:
        self.device = self.device or machine_device()
        require(
            bool(self.runs or self.policies),
            "nothing to report: name runs (--runs='{name: folder}') or --policies",
        )
        named = [
            *self.runs.items(),
            *self.policies.items(),
            *(("--pictures", path) for path in self.pictures),
        ]
        for name, path in named:
            if not Path(path).exists():
                raise FileNotFoundError(f"'{name}': {path} does not exist")
        titles = [path.stem for path in self.pictures]
        require(
            len(set(titles)) == len(titles),
            f"--pictures: the page names a picture after its file, and two of {titles} have one name",
        )
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
        for path in (*self.policies.values(), *map(last_checkpoint, self.runs.values())):
            for n_steps in self.n_action_steps:
                checkpoint_config(path, self.device, n_steps)


def last_checkpoint(run: Path) -> Path:
    """The policy of a run's last checkpoint."""
    return list(checkpoint_steps(run).values())[-1]


def report_run(name: str, run: Path, evaluator: Evaluator, config: ReportConfig) -> list[Result]:
    """Evaluate a run's last checkpoint, and the earlier ones for its learning curve."""
    first, *others = report_policy(name, last_checkpoint(run), evaluator, config)
    *earlier, last = checkpoint_steps(run).items()
    curve = {}
    if config.curve_episodes and earlier:
        n_steps = config.n_action_steps[0] if config.n_action_steps else None
        for step, path in earlier:
            curve[step] = evaluator.evaluate(path, config.curve_episodes, config.seed, n_steps)
        curve[last[0]] = first.finals["last"]
    return [replace(first, curve=curve, rounds=read_reports(run / REPLAY_FOLDER)), *others]


def report_policy(name: str, path: Path, evaluator: Evaluator, config: ReportConfig) -> list[Result]:
    """Evaluate one checkpoint, once for every number of steps that it is to execute per prediction."""
    results = []
    numbers: Sequence[int | None] = config.n_action_steps or [None]
    for n_steps in numbers:
        row = name if n_steps is None else f"{name}, {n_steps} step{'s' * (n_steps != 1)} per chunk"
        final = evaluator.evaluate(path, config.episodes, config.seed, n_steps)
        results.append(Result(name=row, finals={"last": final}, latency=evaluator.latency(path)))
    _note_in_card(path, results, config)
    return results


def _note_in_card(path: Path, results: Sequence[Result], config: ReportConfig) -> None:
    """Write what a checkpoint achieved into its model card, if it has one."""
    success = pooled(results[:1], "last", "success")
    environment = (
        f"`{config.env.type}`, task `{config.env.task}`, {success.n} episodes, seeds from {config.seed}"
    )
    text = f"In {environment}; intervals are 95 % over episodes:\n\n{markdown(summary_table(results))}"
    add_results(Path(path), text, draccus.encode(config.env, EnvConfig), success.mean, success.n)


# ---- the page ----


def run_part(name: str, run: Path, result: Result, config: ReportConfig) -> RunPart:
    """What the page says of a run; draws the contact sheet of its last round if one is wanted."""
    journal, pictures = EpisodeJournal(run / REPLAY_FOLDER), {}
    if config.sheet_episodes and result.rounds:
        number = len(result.rounds) - 1
        sheet = config.output / f"sheet-{list(config.runs).index(name)}.png"
        draw_contact_sheet(journal, number, config.env, config.sheet_episodes, sheet)
        pictures[f"Round {number}: where kept episodes ended, and where dropped ones began"] = sheet
    checkpoint, flags = last_checkpoint(run), environment_flags(config.env)
    commands: dict[str, list[str]] = {
        "Evaluate": ["lerobot-eval", f"--policy.path={checkpoint}", *flags],
        "Watch": [
            "lerobot-agpd-viz",
            f"--policies={{{name}: {checkpoint}}}",
            *flags,
            "--animation=rollout.gif",
        ],
        "Export": ["lerobot-agpd-export", f"--checkpoint={checkpoint}", "--output=exported"],
    }
    ways = ways_of_rounds(journal.root, config.env) if result.rounds else []
    return RunPart(
        name=name,
        rounds=rounds_table(result.rounds) if result.rounds else [],
        ways=round_ways_table(ways),
        pictures=pictures,
        commands=commands,
    )


def write_report_page(results: Sequence[Result], of_run: Mapping[str, Result], config: ReportConfig) -> None:
    """Write report.html; `of_run` has the result of every run with its rounds."""
    pictures = {"Learning curves and collection rounds": config.output / "curves.png"}
    pictures |= {path.stem: path for path in config.pictures}
    write_page(
        config.output / "report.html",
        config.title,
        f"{config.env.type}, task {config.env.task}; {config.episodes} episodes, seeds from {config.seed}",
        summary_table(results),
        pictures,
        [run_part(name, run, of_run[name], config) for name, run in config.runs.items()],
    )


@entry_point("lerobot-agpd-report")
def main(config: ReportConfig) -> None:
    """Evaluate, write and show."""
    config.output.mkdir(parents=True, exist_ok=True)
    environment = draccus.encode(config.env, EnvConfig)
    results: list[Result] = []
    of_entry: dict[str, Result] = {}
    n_envs = min(config.batch_size, config.episodes)
    with closing(Evaluator(config.env, n_envs, config.output, config.device)) as evaluator:
        for entries, evaluate in ((config.policies, report_policy), (config.runs, report_run)):
            for name, path in entries.items():
                rows = evaluate(name, path, evaluator, config)
                of_entry[name], results = rows[0], [*results, *rows]
                write_summary(results, environment, config.seed, config.output)
    draw_report_curves(results, config.title, config.output / "curves.png")
    write_report_page(results, of_entry, config)
    Console().print(console_table(summary_table(results)))
    logger.info("wrote report.html, report.json, report.md and curves.png to %s", config.output)


if __name__ == "__main__":
    main()
