"""Inject faults into tiny runs, and write down what is said about them.

python benchmarks/faults/campaign.py --output benchmarks/faults/faults.json
"""

# ruff: noqa: E402  # those folders must be found first

import argparse
import json
import shlex
import shutil
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

BENCHMARKS = Path(__file__).parents[1]
sys.path[:0] = [str(BENCHMARKS), str(BENCHMARKS.parent / "tests" / "plugins")]
import faulty_point  # noqa: F401
from fault import Bench, run_fault
from faults import FAULTS
from settings import refusals
from tiny_runs import isolated, prepare, train

from lerobot_agpd.files import write_json


def main() -> None:
    """Run the campaign; exit 1 if anything is not as it should be."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--only", default="", help="faults whose name contains this")
    options = parser.parse_args()
    results: dict[str, list[dict[str, object]]] = {}
    settings: dict[str, str | None] = {}
    with tempfile.TemporaryDirectory() as temporary:
        source = Path(temporary) / "source"
        source.mkdir()
        flags = prepare(source)
        codes = train([*flags, f"--output_dir={source / 'finished'}"], source / "finished-log")
        assert codes == [0], (source / "finished-log" / "rank-0.log").read_text()[-2000:]
        for group, faults in FAULTS.items():
            for number, fault in enumerate(
                fault for fault in faults if any(word in fault.name for word in options.only.split(","))
            ):
                folder = Path(temporary) / f"{group}-{number}"
                bench = Bench.create(folder, source, flags)
                result = isolated(lambda fault=fault, bench=bench: asdict(run_fault(fault, bench)))
                assert isinstance(result, dict), result
                as_expected = result["outcome"] == result["expected"] and not result["problems"]
                sys.stdout.write(f"{'ok ' if as_expected else '-> '} {json.dumps(result)}\n")
                sys.stdout.flush()
                results.setdefault(group, []).append(result)
                if as_expected:
                    shutil.rmtree(folder)
        if not options.only:
            settings = refusals()
    counts = [result["outcome"] for group in results.values() for result in group]
    content = {
        "command": shlex.join(sys.argv),
        "outcomes": {outcome: counts.count(outcome) for outcome in sorted(set(counts))},
        "faults": results,
        "settings": {"tried": len(settings), "named": sum(line is not None for line in settings.values())},
        "settings_without_a_line": [name for name, line in settings.items() if line is None],
    }
    write_json(options.output, content, indent=1)


if __name__ == "__main__":
    main()
