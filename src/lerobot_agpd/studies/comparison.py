"""The steps of `lerobot-agpd-compare`: what to run, whether it is done, and the report of what there is."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_agpd.files import write_text
from lerobot_agpd.flag_checks import require
from lerobot_agpd.studies.curves import draw_task_curves
from lerobot_agpd.studies.jobs import Execute, Job
from lerobot_agpd.studies.matrix import Matrix
from lerobot_agpd.studies.outcomes import draw_outcomes
from lerobot_agpd.studies.provenance import digest
from lerobot_agpd.studies.report import comparison_report
from lerobot_agpd.studies.results import Methods
from lerobot_agpd.studies.run_results import read_result, read_results
from lerobot_agpd.studies.runs import Run
from lerobot_agpd.studies.training import TRAIN_LOG, is_trained, noted_start, prepare, train_command

logger = logging.getLogger(__name__)

EVALUATE_LOG = "evaluate.log"
REPORT = "report.md"
MODULES = {
    "lerobot-train": "lerobot.scripts.lerobot_train",
    "lerobot-agpd-compare": "lerobot_agpd.cli.compare",
}


@dataclass(frozen=True)
class Comparison:
    """A matrix and how its runs are made.

    Attributes:
        path: YAML of the matrix.
        matrix: its content.
        threads: OMP_NUM_THREADS of every command.
    """

    path: Path
    matrix: Matrix
    threads: int = 1

    def needs_work(self, run: Run) -> bool:
        """Whether a run still has to be trained or evaluated."""
        try:
            result = read_result(run, self.matrix)
        except ValueError as error:
            logger.warning("making the result again: %s", error)
            return True
        if result is not None and run.policy and result.weights != digest(run.policy):
            logger.warning("evaluating %s again: its weights have changed", run.policy)
            return True
        return result is None

    def job(self, run: Run) -> Job:
        """Train (or resume) a run, then evaluate it."""

        def work(execute: Execute) -> None:
            if not run.policy and not is_trained(run):
                prepare(run)
                command = train_command(run)
                with noted_start(run, command, self.threads):
                    execute(executable(command), run.folder / TRAIN_LOG)
            execute(executable(self._evaluate_command(run)), run.folder / EVALUATE_LOG)

        return Job(run.name, run.folder, work)

    def describe(self, run: Run) -> str:
        """The commands that a run still needs."""
        if not self.needs_work(run):
            return f"# {run.name}: finished"
        commands = [] if run.policy or is_trained(run) else [train_command(run)]
        return "\n".join([f"# {run.name}", *map(shlex.join, [*commands, self._evaluate_command(run)])])

    def _evaluate_command(self, run: Run) -> list[str]:
        args = [f"--matrix={self.path}", f"--output={self.matrix.output}", "--only=evaluate"]
        args += [f"--tasks=[{run.task}]", f"--methods=[{run.method}]"]
        if run.seed is not None:
            args.append(f"--seeds=[{run.seed}]")
        return ["lerobot-agpd-compare", *args]


def executable(command: Sequence[str]) -> list[str]:
    """A command as this Python runs it, whichever scripts the shell would find."""
    return [sys.executable, "-m", MODULES[command[0]], *command[1:]]


def write_report(matrix: Matrix) -> str:
    """Write report.md and the pictures of all that the matrix has results of; returns the report.

    Raises:
        ValueError: if there is no result.
    """
    results, missing = read_results(matrix)
    require(bool(results), f"{matrix.output} holds no result of this comparison yet")
    text = comparison_report(matrix, results, missing)
    write_text(matrix.output / REPORT, text)
    write_pictures(matrix, results, matrix.output)
    return text


def write_pictures(matrix: Matrix, results: Mapping[str, Methods], folder: Path) -> None:
    """Write `outcomes-<task>.png` of all methods and `curves-<task>.png` of the references, for every task."""
    for name, methods in results.items():
        task = matrix.tasks[name]
        title = task.title or name
        draw_outcomes(methods, task.measure, title, folder / f"outcomes-{name}.png")
        shown = {method: runs for method, runs in methods.items() if method in (matrix.references or methods)}
        draw_task_curves(shown, task.measure, title, folder / f"curves-{name}.png")
