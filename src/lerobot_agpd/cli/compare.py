"""`lerobot-agpd-compare`: train, evaluate and compare methods over tasks and seeds, from one YAML; resumable."""

import logging
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.markdown import Markdown

from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.flag_checks import require
from lerobot_agpd.studies.cluster import cluster_executor
from lerobot_agpd.studies.comparison import REPORT, Comparison, write_report
from lerobot_agpd.studies.jobs import Executor, run_jobs
from lerobot_agpd.studies.matrix import load_matrix
from lerobot_agpd.studies.run_results import evaluate_run
from lerobot_agpd.studies.runs import Run, check, expand
from lerobot_agpd.studies.training import check_same_command

logger = logging.getLogger(__name__)

Phase = Literal["all", "evaluate", "report"]
ExecutorName = Literal["threads", "slurm", "local"]
SUBMITTED = "submitted"
"""Folder of submitit's files, in the output."""


@dataclass
class CompareConfig:
    """Options of `lerobot-agpd-compare`."""

    # YAML of the comparison, see benchmarks/comparison.
    matrix: Path
    # Folder of runs and report; default: the matrix's.
    output: Path | None = None
    # A part of the work: evaluate, in this process, what is trained; or only write the report.
    only: Phase = "all"
    # Part of the matrix's tasks; default: all.
    tasks: list[str] = field(default_factory=list)
    # Part of its methods; default: all.
    methods: list[str] = field(default_factory=list)
    # Part of its training seeds; default: all.
    seeds: list[int] = field(default_factory=list)
    # threads: --jobs runs at a time on this machine; slurm: jobs of a cluster, by submitit; local: submitit's processes here.
    executor: ExecutorName = "threads"
    # Settings of submitit's jobs, such as {timeout_min: 240, slurm_partition: gpu}.
    executor_options: dict[str, int | str] = field(default_factory=dict)
    # Runs at a time (executor=threads).
    jobs: int = 1
    # OMP_NUM_THREADS of each.
    threads: int = 1
    # Print the commands and stop.
    dry_run: bool = False

    def __post_init__(self) -> None:
        for name in ("jobs", "threads"):
            require(getattr(self, name) >= 1, f"--{name} must be at least 1, got {getattr(self, name)}")


def load(config: CompareConfig) -> tuple[Comparison, list[Run]]:
    """The comparison and the chosen runs, checked as far as that is possible before anything starts."""
    matrix = load_matrix(config.matrix)
    if config.output is not None:
        matrix.output = config.output
    runs = expand(matrix, config.tasks, config.methods, config.seeds)
    if config.only != "report":
        check(matrix, runs)
        for run in runs:
            check_same_command(run)
    return Comparison(config.matrix, matrix, config.threads), runs


def make_executor(config: CompareConfig, output: Path) -> Executor:
    """What makes the runs."""
    if config.executor == "threads":
        return ThreadPoolExecutor(config.jobs)
    return cluster_executor(config.executor, output / SUBMITTED, config.executor_options)


@entry_point("lerobot-agpd-compare")
def main(config: CompareConfig) -> None:
    """Check, run what is missing, report."""
    console = Console()
    comparison, runs = load(config)
    if config.dry_run:
        for run in runs:
            console.print(comparison.describe(run) + "\n", markup=False, highlight=False, soft_wrap=True)
        return
    if config.only == "evaluate":
        for run in runs:
            evaluate_run(comparison.matrix, run)
        return
    failures: dict[str, str] = {}
    if config.only == "all":
        waiting = [run for run in runs if comparison.needs_work(run)]
        logger.info("%d runs, %d of them finished", len(runs), len(runs) - len(waiting))
        jobs = [comparison.job(run) for run in waiting]
        failures = run_jobs(jobs, make_executor(config, comparison.matrix.output), config.threads, console)
    if len(failures) < len(runs):
        console.print(Markdown(write_report(comparison.matrix)))
        logger.info("wrote %s, outcomes-*.png and curves-*.png to %s", REPORT, comparison.matrix.output)
    if failures:
        logger.error("%d runs failed: %s; run the same command to go on", len(failures), ", ".join(failures))
        sys.exit(1)


if __name__ == "__main__":
    main()
