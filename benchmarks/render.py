"""Write docs/results/*.md and the README's tables from the committed results: benchmarks/*/report.json,
benchmarks/latency/latency-*.json, benchmarks/speed/speed-cpu.json, benchmarks/diversity/*/sweep.json,
benchmarks/environments/*.json, benchmarks/interruptions/counts.json, benchmarks/faults/faults.json and
benchmarks/comparison/results/<matrix>/<task>/<method>/<seed>/run.json.

usage: python benchmarks/render.py          (python benchmarks/render.py --check fails if a page is out of date)
"""

import json
import os
import re
import sys
from itertools import groupby
from pathlib import Path

import committed
import numpy as np
from robustness import faults_page, interruptions_page

from lerobot_agpd.studies.comparison import write_pictures
from lerobot_agpd.studies.frontier import NAMES
from lerobot_agpd.studies.matrix import Matrix, load_matrix
from lerobot_agpd.studies.report import comparison_report
from lerobot_agpd.studies.results import RunResult
from lerobot_agpd.studies.run_results import read_results
from lerobot_agpd.studies.statistics import success_rate
from lerobot_agpd.studies.tables import difference_cell, markdown, raised, rounds_table, summary_table

ROOT = Path(__file__).parent.parent
BENCHMARKS = ROOT / "benchmarks"
COMPARISON = BENCHMARKS / "comparison"
PAGES = ROOT / "docs" / "results"
README = ROOT / "README.md"
OVERVIEW = PAGES / "index.md"
WHEN = ROOT / "docs" / "when_guidance_helps.md"
SUMMARY = {"bc": "cloning", "pd": "PD", "agpd": "AGPD", "teacher": "teacher"}
"""Methods of the overview, and their names there; the pages behind its links have all of them."""

PUBLISHED, SAMPLERS = "DP-C, published", {"100 DDPM": "100 steps", "10 DDIM": "10 steps"}
"""Rows of the latency benchmark that the README's table shows, and what it calls their samplers."""

SPEED_COLUMNS = {
    "cpu_ms": "CPU, ms",
    "wall_ms": "wall, ms",
    "frames_per_s": "kept frames/s",
    "bytes": "bytes",
    "ratio": "ratio",
}
"""What the benchmark of speed measures, and the columns' names; wall time is shown where there is no CPU time."""

Results = dict[str, dict[str, list[RunResult]]]
"""Task and method to results, one per training seed."""

ROUNDS = "Successful / counted episodes; episodes that are solved at the start count nowhere."


def text(folder: Path) -> str:
    return (folder / "README.md").read_text().rstrip()


def report_page(folder: Path) -> str:
    results = committed.read_report(folder / "report.json")
    parts = [text(folder), markdown(summary_table(results))]
    if (folder / "curves.png").exists():
        parts.append(f"![learning curves](../../benchmarks/{folder.name}/curves.png)")
    for result in results:
        if result.rounds:
            title = f"## Collection rounds of {result.name}"
            parts += [title, ROUNDS, markdown(rounds_table(result.rounds))]
    return "\n\n".join(parts) + "\n"


def latency_page(path: Path) -> str:
    """Milliseconds per chunk: median [95th percentile], one column per batch size."""
    content = json.loads(path.read_text())
    sizes = sorted({entry["batch_size"] for entry in content["entries"]})
    rows = [("", "parameters", "denoising steps", *(f"batch {size}" for size in sizes))]
    entries: dict[tuple[str, str], dict[int, dict]] = {}
    for entry in content["entries"]:
        entries.setdefault((entry["name"], entry["sampler"]), {})[entry["batch_size"]] = entry
    for (name, sampler), cells in entries.items():
        size = f"{cells[sizes[0]]['n_parameters'] / 1e6:.2f} M"
        times = [f"{cells[n]['median_ms']:.1f} [{cells[n]['p95_ms']:.1f}]" for n in sizes]
        rows.append((name, size, sampler, *times))
    where = f"{content['device']}, {content['threads']} thread(s), torch {content['torch']}."
    return f"{text(path.parent)}\n\n{where}\n\n{markdown(rows)}\n"


def speed_page(path: Path) -> str:
    """CPU time and ratios of `benchmarks/speed`, beside the ratios before its improvements."""
    content = json.loads(path.read_text())
    sections = {name: section["rows"] for name, section in content["sections"].items()}
    before = json.loads(path.with_name(f"{path.stem}-before.json").read_text())["sections"]
    host = content["host"]
    versions = ", ".join(f"{name} {content['versions'][name]}" for name in ("python", "torch", "lerobot"))
    machine = f"{host['cpu']}, {host['cores']} cores, {content['threads']} thread; {versions}."
    tables = {
        name: speed_tables(rows, before.get(name, {}).get("rows", {})) for name, rows in sections.items()
    }
    played_ms = sections["rounds"]["environments alone"]["cpu_ms"]  # 16 episodes of 50 steps
    numbers = {
        "step_ms": f"{played_ms / 800:.1f}",
        "played_s": f"{played_ms / 1e3:.2f}",
        "wave_s": f"{50 * 125 * played_ms / 800 / 1e3:.0f}",
        "gigabytes": f"{sections['memory']['bytes per frame in memory']['bytes'] / 1e3:.2f}",
    }
    return text(path.parent).format(**tables, **numbers, machine=machine) + "\n"


def speed_tables(rows: dict[str, dict[str, float]], before: dict[str, dict[str, float]]) -> str:
    """One row per action; a table of its own for each group of rows of which the same was measured."""

    def measured(name: str) -> list[str]:
        keys = [key for key in SPEED_COLUMNS if key in rows[name]]
        return [key for key in keys if key != "wall_ms" or "cpu_ms" not in keys]

    tables = []
    for keys, names in groupby(rows, key=measured):
        table = [("", *(SPEED_COLUMNS[key] for key in keys), "before")]
        for name in names:
            ratio = before.get(name, {}).get("ratio")
            cells = (speed_cell(key, rows[name][key]) for key in keys)
            table.append((name, *cells, "-" if ratio is None else speed_cell("ratio", ratio)))
        known = any(row[-1] != "-" for row in table[1:])
        tables.append(markdown(table if known else [row[:-1] for row in table]))
    return "\n\n".join(tables)


def speed_cell(key: str, value: float) -> str:
    if key == "ratio":
        return f"{value:.2f}"
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def diversity_page(folder: Path) -> str:
    """A sweep of `lerobot-agpd-diversity`: its text, numbers and pictures."""
    columns = ("strategy", "strength", "success", "rms to teacher", "rms to student", "KL to teacher, median")
    rows = [(*columns, "entropy of visited states", "student's states covered")]
    for row in committed.read_sweep(folder / "sweep.json"):
        actions = row["actions"]
        numbers = [actions[key] for key in ("rms_to_teacher", "rms_to_student", "kl_to_teacher_median")]
        rows.append(
            (
                NAMES[row["setting"]["strategy"]],
                f"{row['setting']['strength']:g}",
                f"{row['success']:.2f}",
                *(f"{number:.3f}" for number in numbers),
                "-" if row["entropy"] is None else f"{row['entropy']:.1f}",
                f"{row['coverage']:.3f}",
            )
        )
    pictures = [
        f"![{name}](../../benchmarks/diversity/{folder.name}/{name}.png)"
        for name in ("frontier", "trajectories")
    ]
    return "\n\n".join([text(folder), markdown(rows), *pictures]) + "\n"


def environments_page(folder: Path) -> str:
    """How often operators succeed and how fast the environments are."""
    played: dict[tuple[str, int], dict[float, dict]] = {}
    for row in json.loads((folder / "experts.json").read_text()):
        played.setdefault((row["task"], row["episode_length"]), {})[row["skill"]] = row
    skills = sorted({skill for cells in played.values() for skill in cells}, reverse=True)
    experts = [("", "episode limit", *(f"skill {skill:g}" for skill in skills))]
    for (task, episode_length), cells in played.items():
        experts.append((task, str(episode_length), *(operator_cell(cells[skill]) for skill in skills)))
    speed = json.loads((folder / "speed.json").read_text())
    speeds = [("", "steps per second", "least", "most")]
    for name, row in speed["rows"].items():
        values = (row[key] for key in ("steps_per_second", "least", "most"))
        speeds.append((name, *(f"{value:.{0 if value > 100 else 1}f}" for value in values)))
    tables = {"experts": markdown(experts), "speeds": markdown(speeds)}
    return text(folder).format(**tables, ratio=f"{speed['aloha_ratio']:.1f}") + "\n"


def operator_cell(row: dict) -> str:
    """Success with interval and N; the median length of successes."""
    lengths = [length for length, success in zip(row["lengths"], row["successes"], strict=True) if success]
    median = f"{np.median(lengths):.0f}" if lengths else "-"
    return f"{success_rate(row['successes'])}, N = {len(row['successes'])}; {median}"


def read_comparison(path: Path) -> tuple[Matrix, Results, list[str]] | None:
    """A matrix, its committed results and the names of missing runs; None if nothing of it is committed."""
    folder = COMPARISON / "results" / path.stem
    files = sorted(folder.glob("*/*/seed-*/run.json"))
    if not files:
        return None
    root = json.loads(files[0].read_text())["flags"]["dataset.root"]
    os.environ["AGPD_RUNS"] = root.rpartition("/data/")[0]  # where the runs were made: part of their flags
    matrix = load_matrix(path)
    matrix.output = folder
    return matrix, *read_results(matrix, committed.run)


def comparison_page(path: Path, matrix: Matrix, results: Results, missing: list[str]) -> str:
    notes = (COMPARISON / f"{path.stem}.md").read_text().rstrip()
    pictures = f"../../{matrix.output.relative_to(ROOT)}/"
    return f"{notes}\n\n{comparison_report(matrix, results, missing, pictures)}"


def summary(comparisons: dict[Path, tuple[Matrix, Results, list[str]]], several_ways: bool) -> str:
    """One row per task and one column per method: the task's measure at the last checkpoint."""
    names = SUMMARY
    rows = [("", *names.values(), "AGPD minus PD")]
    for path, (matrix, results, _) in comparisons.items():
        for task, methods in results.items():
            if any(run.ways for runs in methods.values() for run in runs) != several_ways:
                continue
            entry = matrix.tasks[task]
            measure = "" if entry.measure == "success" else ", mean max reward"
            link = f"[{entry.title or task}](comparison-{path.stem}.md){measure}"
            cells = [summary_cell(methods.get(name, []), entry.measure) for name in names]
            if not any(cells):  # other methods were compared there
                continue
            pair = (methods.get("agpd", []), methods.get("pd", []))
            rows.append((link, *cells, difference_cell(*pair, "last", entry.measure)))
    return markdown(rows)


def summary_cell(runs: list[RunResult], measure: str) -> str:
    """The mean over all training seeds; how many there are, as a raised number."""
    if not runs:
        return ""
    value = f"{np.mean([run.finals['last'].values(measure) for run in runs]):.2f}"
    return value if runs[0].steps is None else value + raised(len(runs))


def first_table() -> str:
    """What the README shows first: the quickstart's policies, and the time of published sizes."""
    rows = [("", "success", "N", "ms per chunk", "parameters")]
    latency = json.loads((BENCHMARKS / "latency" / "latency-cpu.json").read_text())["entries"]
    for entry in latency:
        if entry["name"].startswith(PUBLISHED) and entry["batch_size"] == 1 and entry["sampler"] in SAMPLERS:
            size = f"{entry['n_parameters'] / 1e6:.1f} M"
            name = f"published-size teacher, {SAMPLERS[entry['sampler']]}"
            rows.append((name, "-", "-", f"{entry['median_ms']:.0f}", size))
    for result in committed.read_report(BENCHMARKS / "quickstart" / "report.json"):
        final = result.finals["last"]
        size = f"{result.latency.n_parameters / 1e6:.2f} M"
        time = f"{result.latency.median_ms:.1f}"
        rows.append((result.name, str(success_rate(final.successes)), str(len(final.successes)), time, size))
    return markdown(rows)


def filled(page: str, name: str, table: str) -> str:
    """A text whose table between `<!-- name-results -->` and `<!-- end -->` is exchanged."""
    pattern = re.compile(rf"(<!-- {name}-results -->\n).*?(<!-- end -->)", re.DOTALL)
    return pattern.sub(lambda match: f"{match[1]}{table}\n{match[2]}", page)


def render(draw: bool) -> dict[Path, str]:
    """All pages; the pictures of comparisons are drawn beside their results."""
    pages = {README: filled(README.read_text(), "first", first_table())}
    for folder in sorted(path.parent for path in BENCHMARKS.glob("*/report.json")):
        pages[PAGES / f"{folder.name}.md"] = report_page(folder)
    for path in sorted((BENCHMARKS / "latency").glob("latency-*.json")):
        pages[PAGES / f"{path.stem}.md"] = latency_page(path)
    for folder in sorted(path.parent for path in (BENCHMARKS / "diversity").glob("*/sweep.json")):
        pages[PAGES / f"diversity-{folder.name}.md"] = diversity_page(folder)
    pages[PAGES / "speed.md"] = speed_page(BENCHMARKS / "speed" / "speed-cpu.json")
    pages[PAGES / "environments.md"] = environments_page(BENCHMARKS / "environments")
    pages[PAGES / "interruptions.md"] = interruptions_page(BENCHMARKS / "interruptions")
    pages[PAGES / "faults.md"] = faults_page(BENCHMARKS / "faults")
    found = {path: read_comparison(path) for path in sorted(COMPARISON.glob("*.yaml"))}
    comparisons = {path: entry for path, entry in found.items() if entry is not None}
    for path, (matrix, results, missing) in comparisons.items():
        if draw:
            write_pictures(matrix, results, matrix.output)
        pages[PAGES / f"comparison-{path.stem}.md"] = comparison_page(path, matrix, results, missing)
    several = summary(comparisons, several_ways=True)
    overview = filled(OVERVIEW.read_text(), "comparison", summary(comparisons, several_ways=False))
    pages[OVERVIEW] = filled(overview, "ways", several)
    pages[WHEN] = filled(WHEN.read_text(), "ways", several.replace("(comparison", "(results/comparison"))
    return pages


def main() -> None:
    pages = render(draw="--check" not in sys.argv)
    stale = [path for path, page in pages.items() if not path.exists() or path.read_text() != page]
    if "--check" in sys.argv:
        sys.exit(f"out of date, run benchmarks/render.py: {[str(p) for p in stale]}" if stale else 0)
    for path in stale:
        path.parent.mkdir(exist_ok=True)
        path.write_text(pages[path])
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
