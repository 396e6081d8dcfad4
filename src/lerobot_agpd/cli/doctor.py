"""`lerobot-agpd-doctor`: what is wrong with the installation, a run or a dataset, and what to do about it."""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.files import write_json
from lerobot_agpd.flag_checks import require
from lerobot_agpd.health.dataset import examine_dataset
from lerobot_agpd.health.finding import Finding, Severity, is_broken
from lerobot_agpd.health.installation import examine_installation
from lerobot_agpd.health.run_folder import examine_run

STYLES = {
    Severity.OK: "green",
    Severity.NOTE: "cyan",
    Severity.WARNING: "yellow",
    Severity.BROKEN: "bold red",
}


@dataclass
class DoctorConfig:
    """Options of `lerobot-agpd-doctor`, which changes nothing; it ends with 1 if anything is broken."""

    # Output folder of a lerobot-train run, whose checkpoints and collected episodes are examined, too.
    run: Path | None = None
    # Folder of a LeRobotDataset that is examined, too.
    dataset: Path | None = None
    # Also write the findings to this file.
    json: Path | None = None

    def __post_init__(self) -> None:
        for name, folder in (("run", self.run), ("dataset", self.dataset)):
            require(folder is None or folder.is_dir(), f"--{name}={folder} is not a folder")


def show(findings: Sequence[Finding], console: Console) -> None:
    """Print the findings as a table, area by area; what to do stands below what was found."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, style="dim")
    table.add_column(overflow="fold")
    for finding in findings:
        style = STYLES[finding.severity]
        table.add_row(f"[{style}]{finding.severity}[/{style}]", finding.area, _plain(finding.text))
        if finding.remedy:
            table.add_row("", "", f"[bold]->[/bold] {_plain(finding.remedy)}")
    console.print(table)
    counts = {severity: sum(finding.severity is severity for finding in findings) for severity in Severity}
    console.print(", ".join(f"{counts[severity]} {severity}" for severity in reversed(Severity)))


def _plain(text: str) -> str:
    """Text that rich shows as it is: square brackets are no markup."""
    return text.replace("[", r"\[")


@entry_point("lerobot-agpd-doctor")
def main(config: DoctorConfig) -> None:
    """Examine, show, and end with 1 if anything is broken."""
    findings = examine_installation()
    if config.run is not None:
        findings += examine_run(config.run)
    if config.dataset is not None:
        findings += examine_dataset(config.dataset)
    show(findings, Console())
    if config.json is not None:
        write_json(config.json, {"findings": [asdict(finding) for finding in findings]}, indent=2)
    if is_broken(findings):
        sys.exit(1)


if __name__ == "__main__":
    main()
