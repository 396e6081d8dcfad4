"""Ctrl-C and SIGTERM while a policy trains: say how the run goes on, then end as the process would have."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

logger = logging.getLogger(__name__)

DEFAULTS = (signal.default_int_handler, signal.SIG_DFL)
"""Handlers that are replaced; any other belongs to a launcher or a notebook, and is left alone."""


class InterruptMessage:
    """Logs a message when the process is interrupted.

    Ctrl-C then raises KeyboardInterrupt as always, but Python prints no traceback if nobody catches it. SIGTERM then ends
    the process at once, as always.

    Args:
        text: called for the message, in the middle of anything; None: no message, for all processes but one.
    """

    def __init__(self, text: Callable[[], str] | None):
        self.text = text
        self._process = os.getpid()
        self._previous: dict[int, Any] = {}

    def watch(self) -> None:
        """Handle the signals from now on; outside the main thread, where Python does not allow that, nothing happens."""
        if threading.current_thread() is not threading.main_thread():
            return
        # While a process waits for others, in torch, Python handles no signal: without a message the default ends it.
        for number in (signal.SIGINT,) if self.text is None else (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            earlier = getattr(handler, "__self__", None)
            if isinstance(earlier, InterruptMessage):  # of a run that has ended, in the same process
                earlier.restore()
                handler = signal.getsignal(number)
            if handler in DEFAULTS:
                self._previous[number] = handler
                signal.signal(number, self._handle)

    def restore(self) -> None:
        """Put the earlier handlers back."""
        if threading.current_thread() is not threading.main_thread():
            return
        for number, previous in self._previous.items():
            if signal.getsignal(number) == self._handle:
                signal.signal(number, previous)
        self._previous.clear()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.restore()
        in_child = os.getpid() != self._process  # forked, as data loader workers may be: no run of its own
        if self.text is not None and not in_child:
            logger.warning("interrupted by %s: %s", signal.Signals(number).name, self.text())
        if number == signal.SIGINT:
            if not in_child:
                sys.excepthook = _without_traceback(sys.excepthook)
            raise KeyboardInterrupt
        os.kill(os.getpid(), number)


ExceptHook = Callable[[type[BaseException], BaseException, TracebackType | None], Any]


def _without_traceback(hook: ExceptHook) -> ExceptHook:
    """An exception hook that prints nothing of a KeyboardInterrupt."""

    def quiet(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if not issubclass(kind, KeyboardInterrupt):
            hook(kind, error, traceback)

    return quiet
