"""Pages of the campaigns that kill runs and inject faults, from their committed results."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

from lerobot_agpd.studies.tables import markdown

WAYS = {"resumed from a checkpoint": "resumed", "repeated with its episodes": "repeated"}

GROUPS = {
    "numbers": "Numbers that are not finite, other rates",
    "files": "Damaged and missing files",
    "environments": "Environments",
    "runs": "Disks, and folders of other runs",
    "signals": "Signals",
}


def interruptions_page(folder: Path) -> str:
    """Kills by the numbers of processes before and after them, and what was found."""
    content = json.loads((folder / "counts.json").read_text())
    counts: dict[str, Counter[str]] = {}
    for entry in content["trials"]:
        processes, kills = entry["trial"]["processes"], entry["trial"]["kills"]
        for number in range(entry["killed"]):
            row = counts.setdefault(f"{processes[number]} -> {processes[number + 1]}", Counter())
            row["at an operation" if kills[number]["operation"] else "at a random time"] += 1
            row[WAYS[entry["continued"][number]]] += 1
            row["with findings"] += bool(entry["problems"])
    columns = ("at an operation", "at a random time", *WAYS.values(), "with findings")
    rows = [("processes", *columns)]
    rows += [(name, *(str(row[column]) for column in columns)) for name, row in sorted(counts.items())]
    total = sum(counts.values(), Counter())
    rows.append(("all", *(str(total[column]) for column in columns)))
    trials = content["trials"]
    return (folder / "README.md").read_text().rstrip().format(
        table=markdown(rows),
        **_long_run(folder / "long_run.json"),
        kills=total["at an operation"] + total["at a random time"],
        trials=len(trials),
        planned=content["planned"],
        operations=sum(sum(counted) for counted in content["file_operations"].values()),
        episodes=sum(entry.get("episodes", 0) for entry in trials),
        kept=sum(entry.get("kept", 0) for entry in trials),
    ) + "\n"


def _long_run(path: Path) -> dict[str, str]:
    """Some samples of the long run, and how long it was."""
    content = json.loads(path.read_text())
    samples = content["samples"]
    rows = [("minutes", "rounds", "resident memory, MiB", "file handles", "threads")]
    for seconds, rss, handles, threads, rounds in [*samples[4 :: len(samples) // 7], samples[-1]]:
        rows.append(
            (f"{seconds / 60:.1f}", f"{rounds:.0f}", f"{rss:.0f}", f"{handles:.0f}", f"{threads:.0f}")
        )
    minutes, rounds = samples[-1][0] / 60, samples[-1][-1]
    return {"long_table": markdown(rows), "minutes": f"{minutes:.0f}", "rounds": f"{rounds:.0f}"}


def faults_page(folder: Path) -> str:
    """Every fault with what happened before and what happens now."""
    content = json.loads((folder / "faults.json").read_text())
    parts = []
    for group, title in GROUPS.items():
        rows = [("fault", "before", "now", "the line")]
        rows += [_fault_row(entry) for entry in content["faults"][group]]
        parts.append(f"## {title}\n\n{markdown(rows)}")
    outcomes = ", ".join(f"{count} {name}" for name, count in content["outcomes"].items())
    text = (folder / "README.md").read_text().rstrip()
    filled = text.format(
        outcomes=outcomes,
        n_faults=sum(content["outcomes"].values()),
        silent=content["outcomes"].get("silent", 0),
        tried=content["settings"]["tried"],
        in_one_line=content["settings"]["in_one_line"],
        in_several=len(content["settings"]["in_several_lines"]),
        not_named=len(content["settings"]["not_named"]),
    )
    return "\n\n".join([filled, *parts]) + "\n"


def _fault_row(entry: dict[str, Any]) -> tuple[str, ...]:
    problems = f" ({'; '.join(entry['problems'])})" if entry["problems"] else ""
    line = entry["line"].replace("|", r"\|").replace("<folder>/", "").replace("<source>/", "")
    return entry["fault"], entry["before"] or "-", f"{entry['outcome']}{problems}", f"`{line}`"
