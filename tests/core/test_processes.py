"""Worker processes are replaced when they die, and do not outlive their parent."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from robotdiffuse.core.processes import SingleWorker, terminate

ROOT = Path(__file__).parents[2]
HELD = 60
"""Longer than a worker may outlive its parent [s]."""


def nothing() -> None:
    pass


class AliveWhenAsked(multiprocessing.get_context("spawn").Process):
    """Ends and is reaped as soon as it has reported that it is alive."""

    def is_alive(self) -> bool:
        alive = super().is_alive()
        self.join()
        return alive


def test_a_single_worker_is_replaced_when_it_dies_or_is_ended() -> None:
    worker = SingleWorker(nothing, ())
    try:
        first = worker.call(os.getpid)
        with pytest.raises(BrokenProcessPool):
            worker.call(os.kill, first, signal.SIGKILL)
        second = worker.call(os.getpid)
        worker.terminate(signal.SIGKILL)
        third = worker.call(os.getpid)
        assert len({first, second, third, os.getpid()}) == 4
        sent = worker.submit(time.sleep, HELD)
        os.kill(third, signal.SIGTERM)
        with pytest.raises(BrokenProcessPool):
            sent.result(HELD)
    finally:
        worker.close()
    with pytest.raises(BrokenProcessPool, match="closed"):
        worker.call(os.getpid)


def test_a_process_that_ends_on_its_own_meanwhile_is_no_error() -> None:
    """`SingleWorker.close` raised ProcessLookupError if a thread of the pool had reaped the process."""
    process = AliveWhenAsked(target=nothing)
    process.start()
    terminate([process], signal.SIGTERM, patience=float(HELD))
    assert process.exitcode == 0


@pytest.mark.skipif(not hasattr(os, "O_ASYNC"), reason="needs a signal on a closed pipe")
def test_a_worker_in_compiled_code_does_not_outlive_a_killed_parent() -> None:
    paths = os.pathsep.join((str(ROOT / "src"), str(ROOT / "tests")))
    with subprocess.Popen(
        [sys.executable, "-m", "helpers.deaf_worker", str(HELD)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
    ) as parent:
        assert parent.stdout is not None
        worker = Path("/proc", parent.stdout.readline().strip())
        assert parent.stdout.readline() == "begun\n" and worker.exists()
        time.sleep(0.5)  # for the call to begin
        parent.kill()
        until = time.monotonic() + HELD / 4
        while worker.exists():
            assert time.monotonic() < until, "it lives as long as its call"
            time.sleep(0.02)


CHECKS = """
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.processes import on_this_machine
try:
    print(sorted(on_this_machine(abs, [(-1,), (-2,)], 2)))
except InputError as error:
    print(error)
"""


@pytest.mark.parametrize("by", ["file", "stdin", "text"])
def test_shared_calls_of_a_script_that_processes_cannot_import_say_what_to_do(
    by: str, tmp_path: Path
) -> None:
    script = tmp_path / "script.py"
    script.write_text(CHECKS)
    arguments = {"file": [str(script)], "stdin": ["-"], "text": ["-c", CHECKS]}[by]
    command = [sys.executable, *arguments]
    ended = subprocess.run(command, input=CHECKS, capture_output=True, text=True, timeout=500, check=True)
    if by == "text":
        assert ended.stdout == "[(0, 1), (1, 2)]\n"
    else:
        assert ended.stdout.endswith('below the line: if __name__ == "__main__":\n')


SWALLOWING = """
import ctypes, signal, time
from robotdiffuse.core.processes import exit_on_interrupt
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
