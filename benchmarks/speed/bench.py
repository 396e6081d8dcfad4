"""Measure how fast training, collection and sampling are: against LeRobot, and against what no code around them could beat.

All in one process, the compared actions in turn; medians of CPU and wall time. Writes speed-<device>.json beside this file,
from which benchmarks/render.py makes a page.
usage: MUJOCO_GL=egl python benchmarks/speed/bench.py [--sections student,teacher] [--device=cuda] [--output=FILE]
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import time
from pathlib import Path

import torch
from lerobot.utils.import_utils import register_third_party_plugins
from sections import SECTIONS

from lerobot_agpd.studies.provenance import provenance


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "--sections", default=",".join(SECTIONS), help="which are measured; the file keeps the others"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    register_third_party_plugins()
    logging.disable(logging.WARNING)
    path = options.output or Path(__file__).with_name(f"speed-{options.device}.json")
    chosen = options.sections.split(",")
    facts = provenance()
    commit = facts.pop("git")
    earlier = json.loads(path.read_text())["sections"] if path.exists() else {}
    content = {
        **facts,
        "device": torch.cuda.get_device_name() if options.device == "cuda" else "cpu",
        "threads": options.threads,
        "sections": earlier,
    }
    for name in chosen:
        began = time.perf_counter()
        rows = SECTIONS[name](options.device)
        seconds = time.perf_counter() - began
        load = os.getloadavg()[0]
        content["sections"][name] = {"git": commit, "seconds": seconds, "load": load, "rows": rows}
        path.write_text(json.dumps(content, indent=1) + "\n")
        print(f"{name} ({seconds:.0f} s)")
        for row, values in rows.items():
            print(
                f"  {row:48s}", *(f"{key} {value:.4g}" for key, value in values.items()), sep="  ", flush=True
            )


if __name__ == "__main__":
    main()
