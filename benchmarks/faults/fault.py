"""What a fault is, and what is seen of a run that has one."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tiny_runs import Inside, train

Outcome = Literal["refused", "named", "stopped", "dropped", "warned", "unclear", "silent"]
"""refused: before the first step, in one line that names what is wrong; named: LeRobot refuses it in its own words, and a
line before them names what is wrong; stopped: later than the first step, in one line; dropped: episodes are left out and
counted; warned: the run goes on after a line that names what is wrong; unclear: it ends without such a line; silent: it
goes on without a word."""

STARTED = "Start offline training"
"""LeRobot's words before the first step."""

EXCEPTION = re.compile(r"^[\w.]*(Error|Exception|Interrupt|Exit): ")
NOISE = re.compile(r"^.*(WARNING|ERROR)( \d{4}-\d\d-\d\d [\d:]+ \S+:\d+ |:lerobot_agpd[\w.]*:)")
"""What LeRobot's logging, and a progress bar on the same line, put before a message."""

CURSOR = re.compile(r"\x1b\[[A-Z]")
"""Moves of the cursor."""

PROGRESS = re.compile(r"\d+/\d+ \[")
"""Lines of progress bars."""


@dataclass
class Bench:
    """A folder with copies of everything that a fault may damage.

    Attributes:
        folder: of the trial.
        flags: of an undamaged `lerobot-train` with the copies.
    """

    folder: Path
    source: Path
    flags: list[str]

    @classmethod
    def create(cls, folder: Path, source: Path, flags: list[str]) -> Bench:
        """Copy demonstrations and teacher of `source`, and name the copies in the flags."""
        for name in ("demos", "teacher"):
            shutil.copytree(source / name, folder / name, symlinks=True)
        moved = [flag.replace(str(source), str(folder)) for flag in flags]
        return cls(folder, source, moved)

    @property
    def demos(self) -> Path:
        """The demonstrations."""
        return self.folder / "demos"

    @property
    def teacher(self) -> Path:
        """The teacher's checkpoint."""
        return self.folder / "teacher" / "checkpoints" / "last" / "pretrained_model"

    @property
    def output(self) -> Path:
        """Output folder of the run."""
        return self.folder / "run"

    def finished(self) -> Path:
        """A copy of a run with two rounds and checkpoints after steps 3 and 6, in the place of this one's."""
        shutil.copytree(self.source / "finished", self.output, symlinks=True)
        return self.output

    def begin(self, *more: str) -> list[str]:
        """Flags of a new run."""
        return [*self.flags, f"--output_dir={self.output}", *more]

    def resume(self, *more: str) -> list[str]:
        """Flags that go on from the checkpoint after step 3."""
        config = self.output / "checkpoints" / "000003" / "pretrained_model" / "train_config.json"
        moved = [f"--dataset.root={self.demos}", f"--policy.teacher.path={self.teacher}"]
        return [f"--config_path={config}", "--resume=true", f"--output_dir={self.output}", *moved, *more]


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong.

    Attributes:
        name: of the fault.
        inject: damages a bench and returns the flags of the run.
        expected: outcome.
        names: words that the line must hold; `{output}`, `{demos}` and `{teacher}` stand for the folders.
        before: what a review of an early version saw, if it looked at this; from its text, not measured here.
        inside: of the run's process.
        afterwards: what is wrong in the end, if anything.
        seconds: after which the run is killed.
    """

    name: str
    inject: Callable[[Bench], list[str]]
    expected: Outcome
    names: tuple[str, ...] = ()
    before: str = ""
    inside: Callable[[Bench], Inside] | None = None
    afterwards: Callable[[Bench], list[str]] | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Result:
    """What was seen of a fault."""

    fault: str
    before: str
    expected: Outcome
    outcome: Outcome
    line: str
    problems: list[str] = field(default_factory=list)

    @property
    def is_as_expected(self) -> bool:
        """Whether nothing is left to be done."""
        return self.outcome == self.expected and not self.problems


def run_fault(fault: Fault, bench: Bench) -> Result:
    """Inject a fault, run, and say what was seen."""
    flags = fault.inject(bench)
    inside = fault.inside(bench) if fault.inside else None
    (code,) = train(flags, bench.folder / "log", inside=inside, seconds=fault.seconds)
    log = (bench.folder / "log" / "rank-0.log").read_text(errors="replace")
    places = {"output": bench.output, "demos": bench.demos, "teacher": bench.teacher}
    names = [name.format(**places) for name in fault.names]
    lines = [NOISE.sub("", line).strip() for line in CURSOR.sub("", log).splitlines()]
    lines = [line for line in lines if line and not PROGRESS.search(line)]
    said = [line for line in lines if all(name in line for name in names)]
    last = lines[-1] if lines else ""
    outcome: Outcome
    if code:
        later = "stopped" if STARTED in log else "refused"
        outcome = later if last in said else "named" if said else "unclear"
    else:
        outcome = "silent" if not said else "dropped" if _invalid_episodes(bench.output) else "warned"
    problems = fault.afterwards(bench) if fault.afterwards else []
    shown = said[0] if said and last not in said else last
    for place, name in ((bench.folder, "<folder>"), (bench.source, "<source>")):
        shown = shown.replace(str(place), name)
    return Result(fault.name, fault.before, fault.expected, outcome, EXCEPTION.sub("", shown), problems)


def _invalid_episodes(output: Path) -> int:
    reports = (json.loads(path.read_text()) for path in output.glob("agpd/round-*/report.json"))
    return sum(report["total"]["invalid"] for report in reports)
