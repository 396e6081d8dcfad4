"""All faults, by kind."""

from environment_faults import ENVIRONMENTS
from fault import Fault
from file_faults import FILES, NUMBERS
from run_faults import RUNS, SIGNALS

FAULTS: dict[str, list[Fault]] = {
    "numbers": NUMBERS,
    "files": FILES,
    "environments": ENVIRONMENTS,
    "runs": RUNS,
    "signals": SIGNALS,
}
