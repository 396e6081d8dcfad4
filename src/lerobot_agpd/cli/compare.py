"""`lerobot-agpd-compare`: train, evaluate and compare methods over tasks and seeds, from one YAML; resumable."""

import logging
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import draccus
from rich.console import Console
from rich.markdown import Markdown

from lerobot_agpd.cli.command import command
from lerobot_agpd.comparison.evaluations import evaluate_run
from lerobot_agpd.comparison.files import write_text
from lerobot_agpd.comparison.jobs import Job, Step, run_jobs
from lerobot_agpd.comparison.matrix import Matrix, load_matrix
from lerobot_agpd.comparison.pictures import write_pictures
from lerobot_agpd.comparison.provenance import digest
from lerobot_agpd.comparison.results import RunResult, read_result, read_results
from lerobot_agpd.comparison.runs import Run, check, expand
from lerobot_agpd.comparison.table import report
from lerobot_agpd.comparison.training import (
    TRAIN_LOG,
    StartLog,
    check_same_command,
    executable,
    prepare,
    progress,
    replay_parent,
    train_command,
)
from lerobot_agpd.guidance.config import require
from lerobot_agpd.replay.store import ReplayStore

logger = logging.getLogger(__name__)

PHASES = ("all", "train", "evaluate", "report")
EVALUATE_LOG = "evaluate.log"
REPORT = "report.md"


@dataclass
class CompareConfig:
    """Options of `lerobot-agpd-compare`."""

    matrix: Path  # YAML of the comparison, see benchmarks/comparison
    output: Path | None = None  # folder of runs and report; default: the matrix's
    only: str = "all"  # all, train, evaluate or report; a single run is evaluated in this process
    tasks: list[str] = field(default_factory=list)  # part of the matrix's tasks; default: all
    methods: list[str] = field(default_factory=list)  # part of its methods; default: all
    seeds: list[int] = field(default_factory=list)  # part of its training seeds; default: all
    jobs: int = 1  # runs at a time
    threads: int = 1  # OMP_NUM_THREADS of each
    dry_run: bool = False  # print the commands and stop

    def __post_init__(self) -> None:
        require(self.only in PHASES, f"--only must be one of {list(PHASES)}, got '{self.only}'")
        for name in ("jobs", "threads"):
            require(getattr(self, name) >= 1, f"--{name} must be at least 1, got {getattr(self, name)}")


def load(config: CompareConfig) -> tuple[Matrix, list[Run]]:
    """The matrix and the chosen runs, checked as far as that is possible before anything starts."""
    matrix = load_matrix(config.matrix)
    if config.output is not None:
        matrix.output = config.output
    runs = expand(matrix, config.tasks, config.methods, config.seeds)
    if config.only != "report":
        check(matrix, runs)
        for run in runs:
            check_same_command(run)
    return matrix, runs


# ---- running ----


def job(config: CompareConfig, matrix: Matrix, run: Run) -> Job:
    """Train (or resume) a run, then evaluate it."""
    steps = []
    if config.only != "evaluate" and not run.policy:
        steps.append(training_step(run, config.threads))
    if config.only != "train":
        words = executable(evaluate_command(config, matrix, run))
        steps.append(Step(lambda: words, run.folder / EVALUATE_LOG))
    return Job(run.name, run.folder, steps)


def training_step(run: Run, threads: int) -> Step:
    """The lerobot-train command of a run, noted in its log of starts."""
    starts: list[StartLog] = []

    def command() -> Sequence[str] | None:
        reached = progress(run)
        if reached is not None and reached.finished:
            return None
        prepare(run)
        words = train_command(run)
        starts.append(StartLog(run))
        starts[0].begin(run, words, threads)
        return executable(words)

    return Step(command, run.folder / TRAIN_LOG, lambda returncode: starts[0].end(returncode))


def evaluate_command(config: CompareConfig, matrix: Matrix, run: Run) -> list[str]:
    """The command that evaluates one run."""
    words = [f"--matrix={config.matrix}", f"--output={matrix.output}", "--only=evaluate"]
    words += [f"--tasks=[{run.task}]", f"--methods=[{run.method}]"]
    if run.seed is not None:
        words.append(f"--seeds=[{run.seed}]")
    return ["lerobot-agpd-compare", *words]


def needs_work(config: CompareConfig, matrix: Matrix, run: Run) -> bool:
    """Whether a run still has to be trained or evaluated."""
    if config.only == "train":
        reached = progress(run)
        return not run.policy and not (reached is not None and reached.finished)
    try:
        result = read_result(run, matrix)
    except ValueError as error:
        logger.warning("making the result again: %s", error)
        return True
    if result is not None and run.policy and result.weights != digest(run.policy):
        logger.warning("evaluating %s again: its weights have changed", run.policy)
        return True
    return result is None


def show_commands(config: CompareConfig, matrix: Matrix, runs: Sequence[Run], console: Console) -> None:
    """Print what would be run."""
    for run in runs:
        reached = progress(run)
        state = f"at step {reached.step} of {reached.steps}" if reached else "not begun"
        state = "evaluated only" if run.policy else state
        state = state if needs_work(config, matrix, run) else "finished"
        lines = [f"# {run.name}: {state}"]
        if config.only != "evaluate" and not run.policy and not (reached and reached.finished):
            lines.append(shlex.join(train_command(run)))
        if config.only != "train":
            lines.append(shlex.join(evaluate_command(config, matrix, run)))
        console.print("\n".join(lines) + "\n", markup=False, highlight=False, soft_wrap=True)


# ---- reporting ----


def write_report(matrix: Matrix) -> str:
    """Write report.md and the pictures of all that the matrix has results of; returns the report.

    Raises:
        ValueError: if there is no result.
    """
    found, missing = read_results(matrix, _readable)
    require(bool(found), f"{matrix.output} holds no result of this comparison yet")
    text = report(matrix, found, missing)
    write_text(matrix.output / REPORT, text)
    write_pictures(matrix, found, matrix.output)
    return text


def _readable(run: Run, matrix: Matrix) -> RunResult | None:
    try:
        return read_result(run, matrix)
    except ValueError as error:
        logger.warning("left out of the report: %s", error)
        return None


@draccus.wrap()
def run(config: CompareConfig) -> None:
    """Check, run what is missing, report."""
    console = Console()
    matrix, runs = load(config)
    if config.dry_run:
        show_commands(config, matrix, runs, console)
        return
    failures: dict[str, str] = {}
    if config.only == "evaluate" and len(runs) == 1:
        evaluate_run(matrix, runs[0], ReplayStore(replay_parent(runs[0]) / "agpd").reports())
        return
    if config.only != "report":
        waiting = [entry for entry in runs if needs_work(config, matrix, entry)]
        logger.info("%d runs, %d of them finished", len(runs), len(runs) - len(waiting))
        jobs = [job(config, matrix, entry) for entry in waiting]
        failures = run_jobs(jobs, config.jobs, config.threads, console)
    if config.only != "train" and len(failures) < len(runs):
        console.print(Markdown(write_report(matrix)))
        logger.info("wrote %s, outcomes-*.png and curves-*.png to %s", REPORT, matrix.output)
    if failures:
        logger.error("%d runs failed: %s; run the same command to go on", len(failures), ", ".join(failures))
        sys.exit(1)


def main() -> None:
    """Console entry point."""
    with command("lerobot-agpd-compare"):
        run()


if __name__ == "__main__":
    main()
