"""The steps of `lerobot-agpd-compare`: what to run, whether it is done, and the report of what there is."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_agpd.config import require
from lerobot_agpd.files import write_text
from lerobot_agpd.rollout.report import read_reports
from lerobot_agpd.studies.curves import draw_task_curves
from lerobot_agpd.studies.jobs import Job, Step
from lerobot_agpd.studies.matrix import Matrix
from lerobot_agpd.studies.outcomes import draw_outcomes
from lerobot_agpd.studies.provenance import digest
from lerobot_agpd.studies.report import comparison_report
from lerobot_agpd.studies.results import Methods, RunResult
from lerobot_agpd.studies.run_results import evaluate_run, read_result, read_results
from lerobot_agpd.studies.runs import Run
from lerobot_agpd.studies.training import (
    TRAIN_LOG,
    StartLog,
    is_trained,
    prepare,
    progress,
    replay_folder,
    train_command,
)

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
        train: whether runs are trained.
        evaluate: whether they are evaluated.
        threads: OMP_NUM_THREADS of every command.
    """

    path: Path
    matrix: Matrix
    train: bool = True
    evaluate: bool = True
    threads: int = 1

    def needs_work(self, run: Run) -> bool:
        """Whether a run still has to be trained or evaluated."""
        if not self.evaluate:
            return not run.policy and not is_trained(run)
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
        steps = []
        if self.train and not run.policy:
            steps.append(training_step(run, self.threads))
        if self.evaluate:
            command = executable(self.evaluate_command(run))
            steps.append(Step(lambda: command, run.folder / EVALUATE_LOG))
        return Job(run.name, run.folder, steps)

    def evaluate_command(self, run: Run) -> list[str]:
        """The command that evaluates one run."""
        args = [f"--matrix={self.path}", f"--output={self.matrix.output}", "--only=evaluate"]
        args += [f"--tasks=[{run.task}]", f"--methods=[{run.method}]"]
        if run.seed is not None:
            args.append(f"--seeds=[{run.seed}]")
        return ["lerobot-agpd-compare", *args]

    def evaluate_here(self, run: Run) -> None:
        """Evaluate one run in this process."""
        evaluate_run(self.matrix, run, read_reports(replay_folder(run)))

    def describe(self, run: Run) -> str:
        """The state of a run and its commands."""
        return "\n".join([f"# {run.name}: {self._state(run)}", *map(shlex.join, self._commands(run))])

    def _state(self, run: Run) -> str:
        reached = progress(run)
        if not self.needs_work(run):
            return "finished"
        if run.policy:
            return "evaluated only"
        return f"at step {reached.step} of {reached.steps}" if reached else "not begun"

    def _commands(self, run: Run) -> Iterator[list[str]]:
        if self.train and not run.policy and not is_trained(run):
            yield train_command(run)
        if self.evaluate:
            yield self.evaluate_command(run)


def training_step(run: Run, threads: int) -> Step:
    """The lerobot-train command of a run, noted in its log of starts."""
    starts: list[StartLog] = []

    def command() -> Sequence[str] | None:
        if is_trained(run):
            return None
        prepare(run)
        args = train_command(run)
        starts.append(StartLog(run))
        starts[0].begin(args, threads)
        return executable(args)

    return Step(command, run.folder / TRAIN_LOG, lambda returncode: starts[0].end(returncode))


def executable(command: Sequence[str]) -> list[str]:
    """A command as this Python runs it, whichever scripts the shell would find."""
    return [sys.executable, "-m", MODULES[command[0]], *command[1:]]


def write_report(matrix: Matrix) -> str:
    """Write report.md and the pictures of all that the matrix has results of; returns the report.

    Raises:
        ValueError: if there is no result.
    """
    results, missing = read_results(matrix, read_or_skip)
    require(bool(results), f"{matrix.output} holds no result of this comparison yet")
    text = comparison_report(matrix, results, missing)
    write_text(matrix.output / REPORT, text)
    write_pictures(matrix, results, matrix.output)
    return text


def read_or_skip(run: Run, matrix: Matrix) -> RunResult | None:
    """Read a result; a damaged or outdated one counts as missing."""
    try:
        return read_result(run, matrix)
    except ValueError as error:
        logger.warning("left out of the report: %s", error)
        return None


def write_pictures(matrix: Matrix, results: Mapping[str, Methods], folder: Path) -> None:
    """Write `outcomes-<task>.png` of all methods and `curves-<task>.png` of the references, for every task."""
    for name, methods in results.items():
        task = matrix.tasks[name]
        title = task.title or name
        draw_outcomes(methods, task.measure, title, folder / f"outcomes-{name}.png")
        shown = {method: runs for method, runs in methods.items() if method in (matrix.references or methods)}
        draw_task_curves(shown, task.measure, title, folder / f"curves-{name}.png")
