"""A run of very many tiny rounds: does it leak memory, file handles or threads?

python benchmarks/interruptions/long_run.py --output benchmarks/interruptions/long_run.json --minutes 120
"""

# ruff: noqa: E402  # the folder above must be found first

import argparse
import os
import shlex
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from tiny_runs import prepare, train

from lerobot_agpd.files import append_line, write_json

EVERY = ["--policy.collect.every=2", "--steps=10000000", "--save_freq=500", "--log_freq=100000"]
COLUMNS = ("seconds", "rss_mib", "file_handles", "threads", "rounds")


def sample(began: float, journal: Path) -> list[float]:
    """The process as it is now; see COLUMNS."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    rss = int(status["VmRSS"].split()[0]) / 1024
    n_rounds = sum(1 for _ in journal.glob("round-*/report.json"))
    handles = len(os.listdir("/proc/self/fd"))
    return [round(time.monotonic() - began, 1), round(rss, 1), handles, int(status["Threads"]), n_rounds]


def main() -> None:
    """Run for so many minutes, sample, write what was seen."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=120)
    parser.add_argument("--interval", type=float, default=20, help="seconds between samples")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        samples, journal = folder / "samples", folder / "run" / "agpd"

        @contextmanager
        def sampled(rank: int) -> Iterator[None]:
            began, ended = time.monotonic(), threading.Event()

            def watch() -> None:
                while not ended.wait(options.interval):
                    append_line(samples, " ".join(map(str, sample(began, journal))))

            threading.Thread(target=watch, daemon=True).start()
            yield
            ended.set()

        flags = [*prepare(folder), *EVERY, f"--output_dir={folder / 'run'}"]
        train(flags, folder / "log", inside=sampled, seconds=60 * options.minutes)
        log = (folder / "log" / "rank-0.log").read_text(errors="replace")
        rows = [[float(word) for word in line.split()] for line in samples.read_text().splitlines()]
    warnings = sum("WARNING" in line or "Error" in line for line in log.splitlines())
    content = {"command": shlex.join(sys.argv), "columns": COLUMNS, "warnings": warnings, "samples": rows}
    write_json(options.output, content)


if __name__ == "__main__":
    main()
