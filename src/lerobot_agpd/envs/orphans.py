"""Worker processes end with the run that started them, even when it is killed; imported by their forkserver.

A worker that waits for its next command notices by itself that nobody is there any more. One that hangs in its environment
does not, and would stay for ever.
"""

import multiprocessing
import os
import threading
import time
from multiprocessing.connection import wait


def _end_with_run() -> None:
    """Start a thread in a process that the forkserver has just forked; it ends the process when the run has ended."""
    threading.Thread(target=_wait_for_end_of_run, name="end with the run", daemon=True).start()


def _wait_for_end_of_run() -> None:
    while (run := multiprocessing.parent_process()) is None:  # known a moment after the fork
        time.sleep(0.1)
    wait([run.sentinel])
    os._exit(1)


os.register_at_fork(after_in_child=_end_with_run)
