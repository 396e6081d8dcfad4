"""Ctrl-C and SIGTERM: a message, no traceback, the default's exit status; nothing of it stays behind."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from lerobot_agpd.interrupts import InterruptMessage

SIGNALS = (signal.SIGINT, signal.SIGTERM)

PROGRAM = """
import logging, os, signal, sys, time
from lerobot_agpd.interrupts import InterruptMessage
logging.basicConfig(format="%(message)s")
message = InterruptMessage({text})
message.watch()
os.kill(os.getpid(), signal.{name})
time.sleep(30)
print("still here")
"""


@pytest.fixture(autouse=True)
def default_handlers(monkeypatch):
    """What Python starts with, whatever started the tests; and an exception hook to compare with."""
    earlier = {number: signal.getsignal(number) for number in SIGNALS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    monkeypatch.setattr("sys.excepthook", sys.__excepthook__)
    yield
    for number, handler in earlier.items():
        signal.signal(number, handler)


def handlers():
    return [signal.getsignal(number) for number in SIGNALS]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("text", ["lambda: 'type this'", "None"])
def test_a_process_says_its_message_and_ends_as_it_would_have(name, text):
    program = "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)" + PROGRAM
    done = subprocess.run(
        [sys.executable, "-c", program.format(name=name, text=text)],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == -getattr(signal, name) and done.stdout == ""
    assert done.stderr == ("" if text == "None" else f"interrupted by {name}: type this\n")


def test_ctrl_c_is_still_an_exception_that_can_be_caught():
    message = InterruptMessage(lambda: "text")
    message.watch()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    assert handlers() == [signal.default_int_handler, signal.SIG_DFL], "the second Ctrl-C is an ordinary one"


def test_other_exceptions_keep_their_traceback(capsys):
    InterruptMessage(None).watch()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    sys.excepthook(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert capsys.readouterr().err == ""
    sys.excepthook(ValueError, ValueError("told"), None)
    assert "ValueError: told" in capsys.readouterr().err


def test_handlers_are_restored_and_replace_those_of_an_earlier_run():
    first, second = InterruptMessage(lambda: "1"), InterruptMessage(lambda: "2")
    first.watch()
    second.watch()
    assert all(handler.__self__ is second for handler in handlers())
    first.restore()
    assert all(handler.__self__ is second for handler in handlers())
    second.restore()
    assert handlers() == [signal.default_int_handler, signal.SIG_DFL]


def test_others_handlers_and_other_threads_are_left_alone():
    def launchers(number, frame):
        pass

    signal.signal(signal.SIGTERM, launchers)
    message = InterruptMessage(lambda: "text")
    thread = threading.Thread(target=message.watch)
    thread.start()
    thread.join()
    assert handlers() == [signal.default_int_handler, launchers]
    message.watch()
    assert handlers()[0].__self__ is message and handlers()[1] is launchers
    message.restore()
    assert handlers() == [signal.default_int_handler, launchers]


def test_processes_without_a_message_keep_the_default_of_sigterm():
    """Waiting for others inside torch, they would never come to handle it."""
    message = InterruptMessage(None)
    message.watch()
    assert handlers()[1] is signal.SIG_DFL
    message.restore()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_child_says_nothing(capfd):
    message = InterruptMessage(lambda: "not the child's")
    message.watch()
    child = os.fork()
    if child == 0:
        os.kill(os.getpid(), signal.SIGTERM)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGTERM
    assert "not the child's" not in capfd.readouterr().err
    message.restore()
