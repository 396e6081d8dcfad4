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
from collections import Counter
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


def count_settings() -> dict[str, object]:
    """How many settings that make no sense are named, and by how many lines."""
    lines = {name: len(said) for name, said in refusals().items()}
    return {
        "tried": len(lines),
        "in_one_line": sum(n == 1 for n in lines.values()),
        "in_several_lines": [name for name, n in lines.items() if n > 1],
        "not_named": [name for name, n in lines.items() if n == 0],
    }


def main() -> None:
    """Inject the faults one after the other, and write down each."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument(
        "--only", help="faults whose name contains one of these words; `settings`: the settings"
    )
    options = parser.parse_args()
    words = options.only.split(",") if options.only else None
    content = json.loads(options.output.read_text()) if options.output.exists() else {"faults": {}}
    with tempfile.TemporaryDirectory() as temporary:
        source = Path(temporary) / "source"
        source.mkdir()
        flags = prepare(source)
        codes = train([*flags, f"--output_dir={source / 'finished'}"], source / "finished-log")
        assert codes == [0], (source / "finished-log" / "rank-0.log").read_text()[-2000:]
        for group, faults in FAULTS.items():
            results = {entry["fault"]: entry for entry in content["faults"].get(group, [])}
            for number, fault in enumerate(faults):
                if words and not any(word in fault.name for word in words):
                    continue
                bench = Bench.create(Path(temporary) / f"{group}-{number}", source, flags)
                result = isolated(lambda fault=fault, bench=bench: asdict(run_fault(fault, bench)))
                assert isinstance(result, dict), result
                shutil.rmtree(bench.folder)
                sys.stdout.write(f"{json.dumps(result)}\n")
                results[fault.name] = result
                content["faults"][group] = list(results.values())
                write_json(options.output, {"command": shlex.join(sys.argv), **content}, indent=1)
        if words is None or "settings" in words:
            content["settings"] = count_settings()
    outcomes = Counter(result["outcome"] for group in content["faults"].values() for result in group)
    content |= {"command": shlex.join(sys.argv), "outcomes": dict(sorted(outcomes.items()))}
    write_json(options.output, content, indent=1)


if __name__ == "__main__":
    main()
