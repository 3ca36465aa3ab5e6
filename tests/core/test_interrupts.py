"""Ctrl-C ends programs, and exits keep their status."""

import subprocess
import sys

import pytest

EXITS = """
import atexit, sys, threading, time
from robotdiffuse.core.interrupts import exit_fast
def late():
    time.sleep(0.2)
    print("thread", flush=True)
def run():
    atexit.register(print, "handler", flush=True)
    threading.Thread(target=late).start()
    {}
exit_fast(run)
"""


@pytest.mark.parametrize(
    ("end", "status"), [("return 3", 3), ("sys.exit(4)", 4), ("raise ValueError", 1), ("sys.exit()", 0)]
)
def test_an_exit_waits_for_threads_and_handlers(end: str, status: int) -> None:
    ended = subprocess.run([sys.executable, "-c", EXITS.format(end)], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout.split()) == (status, ["thread", "handler"])
    assert ("ValueError" in ended.stderr) == (status == 1)


SWALLOWING = """
import ctypes, signal, time
from robotdiffuse.core.interrupts import exit_on_interrupt
with exit_on_interrupt(lambda: print("tidy", flush=True)):
    try:
        ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))()
        time.sleep(0.1)
    except BaseException:
        pass
    print("lives", flush=True)
"""


def test_ctrl_c_is_not_lost_in_callbacks() -> None:
    """`robot add` ran on for minutes after Ctrl-C was pressed while compiled code was loaded."""
    # background jobs of a shell ignore SIGINT
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    ended = subprocess.run([sys.executable, "-c", heard + SWALLOWING], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "tidy\n", "robotdiffuse: stopped\n")


def test_ctrl_c_that_is_ignored_stays_ignored() -> None:
    code = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)" + SWALLOWING
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (0, "lives\n")
