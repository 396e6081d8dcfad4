"""Write docs/results/*.md and the README's tables from the committed results: benchmarks/*/report.json,
benchmarks/latency/latency-*.json, benchmarks/diversity/*/sweep.json, benchmarks/environments/*.json and
benchmarks/comparison/results/<matrix>/<task>/<method>/<seed>/run.json.

usage: python benchmarks/render.py          (python benchmarks/render.py --check fails if a page is out of date)
"""

import json
import os
import re
import sys
from pathlib import Path

import numpy as np

from lerobot_agpd.analysis.frontier import NAMES
from lerobot_agpd.analysis.report import MethodResult, markdown
from lerobot_agpd.analysis.statistics import success_rate
from lerobot_agpd.comparison.matrix import Matrix, load_matrix
from lerobot_agpd.comparison.pictures import write_pictures
from lerobot_agpd.comparison.results import RunResult, read_results
from lerobot_agpd.comparison.table import difference_cell, raised, report

ROOT = Path(__file__).parent.parent
COMPARISON = ROOT / "benchmarks" / "comparison"
SUMMARY = {
    "bc": "cloning",
    "pd": "PD",
    "dagger": "DAgger",
    "agpd": "AGPD",
    "pd_long": "PD, 3x steps",
    "agpd_long": "AGPD, 3x steps",
    "teacher": "teacher",
}
"""Methods of the README's table, and what it calls them."""

Results = dict[str, dict[str, list[RunResult]]]
"""Task and method to results, one per training seed."""

COLUMNS = ("round", "scale", "guided", "unguided", "generated", "kept", "shift in sigmas", "seconds")


def results(folder: Path) -> list[MethodResult]:
    return [
        MethodResult.from_json(entry) for entry in json.loads((folder / "report.json").read_text())["methods"]
    ]


def share(counts: dict) -> str:
    counted = counts["generated"] - counts["trivial"]
    return f"{counts['successful']} / {counted}" if counted else "-"


def rounds_table(rounds: list[dict]) -> str:
    rows = [
        (
            str(entry["round"]),
            f"{entry['scale']:.3g}",
            share(entry["guided"]),
            share(entry["unguided"]),
            str(entry["generated"]),
            str(entry["kept"]),
            "-" if entry["mean_shift_in_sigmas"] is None else f"{entry['mean_shift_in_sigmas']:.2f}",
            f"{sum(entry['seconds'].values()):.0f}",
        )
        for entry in rounds
    ]
    lines = [COLUMNS, tuple("---" for _ in COLUMNS), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def page(folder: Path) -> str:
    parts = [(folder / "README.md").read_text().rstrip(), markdown(results(folder)).rstrip()]
    if (folder / "curves.png").exists():
        parts.append(f"![learning curves](../../benchmarks/{folder.name}/curves.png)")
    for result in results(folder):
        if result.collection:
            parts.append(
                f"## Collection rounds of {result.name}\n\nPassed / counted episodes; trivial starts count nowhere.\n\n"
                + rounds_table(result.collection["rounds"]).rstrip()
            )
    return "\n\n".join(parts) + "\n"


def latency_page(path: Path) -> str:
    """Milliseconds per chunk: median [95th percentile], one column per batch size."""
    content = json.loads(path.read_text())
    sizes = sorted({entry["batch_size"] for entry in content["entries"]})
    header = ("", "parameters", "denoising steps", *(f"batch {size}" for size in sizes))
    rows: dict[tuple[str, str], dict[int, dict]] = {}
    for entry in content["entries"]:
        rows.setdefault((entry["name"], entry["sampler"]), {})[entry["batch_size"]] = entry
    lines = [header, tuple("---" for _ in header)]
    for (name, sampler), cells in rows.items():
        size = f"{cells[sizes[0]]['n_parameters'] / 1e6:.2f} M"
        times = [f"{cells[n]['median_ms']:.1f} [{cells[n]['p95_ms']:.1f}]" for n in sizes]
        lines.append((name, size, sampler, *times))
    where = f"{content['device']}, {content['threads']} thread(s), torch {content['torch']}."
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"{(path.parent / 'README.md').read_text().rstrip()}\n\n{where}\n\n{table}\n"


def diversity_page(folder: Path) -> str:
    """A sweep of `lerobot-agpd-diversity`: its text, numbers and pictures."""
    content = json.loads((folder / "sweep.json").read_text())
    columns = ("strategy", "strength", "success", "rms to teacher", "rms to student", "KL to teacher, median")
    header = (*columns, "entropy of visited states", "student's states covered")
    lines = [header, tuple("---" for _ in header)]
    for row in content["rows"]:
        actions = row["actions"]
        numbers = [actions[key] for key in ("rms_to_teacher", "rms_to_student", "kl_to_teacher_median")]
        lines.append(
            (
                NAMES[row["setting"]["strategy"]],
                f"{row['setting']['strength']:g}",
                f"{row['success']:.2f}",
                *(f"{number:.3f}" for number in numbers),
                "-" if row["entropy"] is None else f"{row['entropy']:.1f}",
                f"{row['coverage']:.3f}",
            )
        )
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    pictures = [
        f"![{name}](../../benchmarks/diversity/{folder.name}/{name}.png)"
        for name in ("frontier", "trajectories")
    ]
    return "\n\n".join([(folder / "README.md").read_text().rstrip(), table, *pictures]) + "\n"


def environments_page(folder: Path) -> str:
    """How often operators succeed and how fast the environments are."""
    played: dict[tuple[str, int], dict[float, dict]] = {}
    for row in json.loads((folder / "experts.json").read_text()):
        played.setdefault((row["task"], row["episode_length"]), {})[row["skill"]] = row
    skills = sorted({skill for cells in played.values() for skill in cells}, reverse=True)
    header = ("", "episode limit", *(f"skill {skill:g}" for skill in skills))
    lines = [header, tuple("---" for _ in header)]
    for (task, episode_length), cells in played.items():
        lines.append((task, str(episode_length), *(operator_cell(cells[skill]) for skill in skills)))
    speed = json.loads((folder / "speed.json").read_text())
    rows = [("", "steps per second", "least", "most"), ("---",) * 4]
    for name, row in speed["rows"].items():
        rows.append(
            (
                name,
                *(
                    f"{row[key]:.{0 if row[key] > 100 else 1}f}"
                    for key in ("steps_per_second", "least", "most")
                ),
            )
        )
    experts, speeds = ("\n".join("| " + " | ".join(line) + " |" for line in table) for table in (lines, rows))
    text = (folder / "README.md").read_text().rstrip()
    return text.format(experts=experts, speeds=speeds, ratio=f"{speed['aloha_ratio']:.1f}") + "\n"


def operator_cell(row: dict) -> str:
    """Success with interval and N; the median length of successes."""
    lengths = [length for length, success in zip(row["lengths"], row["successes"], strict=True) if success]
    median = f"{np.median(lengths):.0f}" if lengths else "-"
    return f"{success_rate(row['successes'])}, N = {len(row['successes'])}; {median}"


def committed(path: Path) -> tuple[Matrix, Results, list[str]] | None:
    """A matrix, its committed results and the names of missing runs; None if nothing of it is committed."""
    results_folder = COMPARISON / "results" / path.stem
    files = sorted(results_folder.glob("*/*/seed-*/run.json"))
    if not files:
        return None
    root = json.loads(files[0].read_text())["flags"]["dataset.root"]
    os.environ["AGPD_RUNS"] = root.rpartition("/data/")[0]  # where the runs were made: part of their flags
    matrix = load_matrix(path)
    matrix.output = results_folder
    return matrix, *read_results(matrix)


def comparison_page(path: Path, matrix: Matrix, found: Results, missing: list[str], draw: bool) -> str:
    """The page of one matrix; its pictures are drawn beside the results."""
    if draw:
        write_pictures(matrix, found, matrix.output)
    text = (COMPARISON / f"{path.stem}.md").read_text().rstrip()
    return f"{text}\n\n{report(matrix, found, missing, f'../../{matrix.output.relative_to(ROOT)}/')}"


def summary(comparisons: dict[Path, tuple[Matrix, Results, list[str]]]) -> str:
    """One row per task and one column per method: the task's measure at the last checkpoint."""
    header = ("", *SUMMARY.values(), "AGPD minus PD")
    lines = [header, tuple("---" for _ in header)]
    for path, (matrix, found, _) in comparisons.items():
        for task, methods in found.items():
            entry = matrix.tasks[task]
            cells = [summary_cell(methods.get(name, []), entry.measure) for name in SUMMARY]
            measure = "" if entry.measure == "success" else ", mean max reward"
            lines.append(
                (
                    f"[{entry.title or task}](docs/results/comparison-{path.stem}.md){measure}",
                    *cells,
                    difference_cell(methods.get("agpd", []), methods.get("pd", []), "last", entry.measure),
                )
            )
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def summary_cell(runs: list[RunResult], measure: str) -> str:
    """The mean over all training seeds; how many there are, as a raised number."""
    if not runs:
        return ""
    value = f"{np.mean([run.values('last', measure) for run in runs]):.2f}"
    return value if runs[0].steps is None else value + raised(len(runs))


def filled(text: str, name: str, table: str) -> str:
    """A text whose table between `<!-- name-results -->` and `<!-- end -->` is exchanged."""
    pattern = re.compile(rf"(<!-- {name}-results -->\n).*?(<!-- end -->)", re.DOTALL)
    return pattern.sub(lambda match: f"{match[1]}{table}\n{match[2]}", text)


def main() -> None:
    readme = ROOT / "README.md"
    pages = {readme: readme.read_text()}
    for folder in sorted(path.parent for path in (ROOT / "benchmarks").glob("*/report.json")):
        pages[ROOT / "docs" / "results" / f"{folder.name}.md"] = page(folder)
        pages[readme] = filled(pages[readme], folder.name, markdown(results(folder)).rstrip())
    for path in sorted((ROOT / "benchmarks" / "latency").glob("latency-*.json")):
        pages[ROOT / "docs" / "results" / f"{path.stem}.md"] = latency_page(path)
    for folder in sorted(path.parent for path in (ROOT / "benchmarks" / "diversity").glob("*/sweep.json")):
        pages[ROOT / "docs" / "results" / f"diversity-{folder.name}.md"] = diversity_page(folder)
    if (ROOT / "benchmarks" / "environments" / "speed.json").exists():
        pages[ROOT / "docs" / "results" / "environments.md"] = environments_page(
            ROOT / "benchmarks" / "environments"
        )
    found = {path: committed(path) for path in sorted(COMPARISON.glob("*.yaml"))}
    comparisons = {path: entry for path, entry in found.items() if entry is not None}
    for path, entry in comparisons.items():
        page_path = ROOT / "docs" / "results" / f"comparison-{path.stem}.md"
        pages[page_path] = comparison_page(path, *entry, draw="--check" not in sys.argv)
    pages[readme] = filled(pages[readme], "comparison", summary(comparisons))
    stale = [path for path, text in pages.items() if not path.exists() or path.read_text() != text]
    if "--check" in sys.argv:
        sys.exit(f"out of date, run benchmarks/render.py: {[str(p) for p in stale]}" if stale else 0)
    for path in stale:
        path.parent.mkdir(exist_ok=True)
        path.write_text(pages[path])
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
