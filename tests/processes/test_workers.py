"""Worker processes are replaced when they die, and do not outlive their parent."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import util
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from helpers import waiting
from helpers.refusals import refuses
from robotdiffuse.processes import workers as module
from robotdiffuse.processes.workers import EndedError, OverrunError, Worker, Workers, allow, cancelled, renew

HELD = 60  # longer than a worker may outlive its parent [s]


def ends(message: str, call: Callable[..., object], *arguments: object) -> None:
    with pytest.raises(EndedError, match=message):
        call(*arguments)


@pytest.fixture
def worker() -> Iterator[Worker]:
    made = Worker()
    yield made
    made.close()


def test_a_single_worker_is_replaced_when_it_dies_or_is_ended(worker: Worker) -> None:
    first = worker.call(os.getpid)
    with pytest.raises(EndedError):
        worker.call(os.kill, first, signal.SIGKILL)
    second = worker.call(os.getpid)
    os.kill(second, signal.SIGKILL)  # between two calls, such as when memory runs out
    waiting.until(lambda: second not in [process.pid for process in multiprocessing.active_children()])
    third = worker.call(os.getpid)
    worker.end()
    fourth = worker.call(os.getpid)
    assert len({first, second, third, fourth, os.getpid()}) == 5
    with ThreadPoolExecutor(1) as threads:
        sent = threads.submit(worker.call, time.sleep, HELD)
        os.kill(fourth, signal.SIGTERM)
        ends("by SIGTERM", sent.result, HELD)
    worker.close()
    ends("closed", worker.call, os.getpid)


def test_closing_waits_for_a_process_that_is_starting(worker: Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: if the program exited while a worker started, the worker printed a traceback."""
    begun, spawn = threading.Event(), util.spawnv_passfds
    pids: list[int] = []

    def slowly(*arguments: Any) -> int:
        pids.append(spawn(*arguments))
        begun.set()
        time.sleep(0.5)
        return pids[0]

    monkeypatch.setattr(util, "spawnv_passfds", slowly)
    with ThreadPoolExecutor(1) as threads:
        sent = threads.submit(worker.call, os.getpid)
        assert begun.wait(HELD)
        worker.close()
        assert not Path(f"/proc/{pids[0]}").exists()
        ends("closed", sent.result, HELD)


def test_too_many_workers_are_refused() -> None:
    """Regression: 100,000 workers started as many threads or processes."""
    refuses("workers is 100000; it must be at most 1024", Workers, 100_000)


LOCKED = """
import multiprocessing
from robotdiffuse.processes.workers import Worker
kept = []
def lock():
    kept.append(multiprocessing.RLock())
if __name__ == "__main__":
    worker = Worker()
    worker.call(lock)
    worker.close()
"""


def test_an_ended_worker_leaves_no_locks(tmp_path: Path) -> None:
    """Regression: at the end of `reproduce table2`, Python warned of a leaked semaphore, the lock of tqdm."""
    (tmp_path / "script.py").write_text(LOCKED)
    assert not subprocess.run([sys.executable, tmp_path / "script.py"], capture_output=True, text=True, check=True).stderr


def wait_until_cancelled() -> None:
    while not cancelled():
        time.sleep(0.01)


def sleep_allowed(first: float, allowed: float, then: float) -> str:
    time.sleep(first)
    allow(allowed)
    time.sleep(then)
    return "done"


def renewed() -> int:
    renew()
    return os.getpid()


class OddError(Exception):
    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


def odd() -> None:
    raise OddError(1, 2)


def test_a_call_that_takes_too_long_is_killed_unless_it_is_allowed_more_time(worker: Worker) -> None:
    first = worker.call(os.getpid)
    worker.call(sleep_allowed, 0.0, float(HELD), 0.0)  # imports this module
    assert worker.call(sleep_allowed, 0.0, float(HELD), 4.0, timeout=3.0) == "done"
    assert worker.call(os.getpid) == first
    with pytest.raises(OverrunError):
        worker.call(sleep_allowed, 0.0, 0.1, float(HELD), timeout=float(HELD))
    assert worker.call(os.getpid) != first


def test_errors_of_calls_keep_the_process(worker: Worker) -> None:
    first = worker.call(os.getpid)
    with pytest.raises(ZeroDivisionError) as raised:
        worker.call(divmod, 1, 0)
    assert "in a worker process" in raised.value.__notes__[0]
    with pytest.raises(Exception, match="pickle"):
        worker.call(eval, "lambda: None")
    with pytest.raises(Exception, match="pickle"):
        worker.call(print, lambda: None)
    with pytest.raises(RuntimeError, match="OddError: 1 and 2"):
        worker.call(odd)
    with pytest.raises(SystemExit):
        worker.call(sys.exit, "no license")
    assert worker.call(os.getpid) == first and worker.call(renewed) == first
    assert worker.call(os.getpid) != first


def test_running_and_waiting_calls_are_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CANCEL_TIMEOUT", HELD)
    with Workers(1) as workers:
        first = workers.submit(os.getpid).result(HELD)
        running = workers.submit(wait_until_cancelled)
        later = workers.submit(os.getpid)
        waiting.until(running.running, HELD)
        assert later.cancel() and not running.cancel()
        assert running.result(HELD) is None
        assert workers.submit(os.getpid).result(HELD) == first
        monkeypatch.undo()
        deaf = workers.submit(time.sleep, float(HELD))
        waiting.until(deaf.running, HELD)
        deaf.cancel()
        with pytest.raises(OverrunError):
            deaf.result(HELD)
        last = workers.submit(time.sleep, float(HELD)), workers.submit(os.getpid)
        waiting.until(last[0].running, HELD)
    for call in last:
        ends("closed", call.result, HELD)


def fail_without(file: str) -> bool:
    new = not os.path.exists(file)
    Path(file).write_text("")
    return new


def test_ready_workers_are_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second process replaces the first if `prepare` returns True, as after compiling, and one that is killed."""
    with Workers(1, fail_without, (str(tmp_path / "file"),), keep_ready=True) as workers:
        workers.start()
        [worker] = workers.workers
        assert worker.ready
        first = workers.submit(os.getpid).result(HELD)
        ends("by SIGKILL", workers.submit(os.kill, first, signal.SIGKILL).result, HELD)
        waiting.until(lambda: worker.ready, HELD)
        assert workers.submit(os.getpid).result(HELD) != first


DEAF = """
import os, sys
from robotdiffuse.processes.workers import Workers
workers = Workers(1)
print(workers.submit(os.getpid).result(), flush=True)
workers.submit(exec, "import ctypes; ctypes.PyDLL(None).sleep({held})")
print("begun", flush=True)
sys.stdin.read()
"""
"""Its worker holds Python's global lock (GIL) for a while, as compiled code may."""


@pytest.mark.skipif(not hasattr(os, "O_ASYNC"), reason="needs a signal on a closed pipe")
def test_a_worker_in_compiled_code_does_not_outlive_a_killed_parent() -> None:
    command = [sys.executable, "-c", DEAF.format(held=HELD)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = Path("/proc", parent.stdout.readline().strip())
        assert parent.stdout.readline() == "begun\n" and worker.exists()
        time.sleep(0.5)  # for the call to begin
        parent.kill()
        waiting.until(lambda: not worker.exists(), HELD / 4)


CHECKS = """
from robotdiffuse.core.errors import InputError
from robotdiffuse.processes.workers import on_this_machine
try:
    print(sorted(on_this_machine(abs, [(-1,), (-2,)], 2)))
except InputError as error:
    print(error)
"""


@pytest.mark.parametrize("by", ["-", "-c"])
def test_shared_calls_of_a_script_that_processes_cannot_import_say_what_to_do(by: str) -> None:
    command = [sys.executable, by, *([CHECKS] if by == "-c" else [])]
    ended = subprocess.run(command, input=CHECKS, capture_output=True, text=True, timeout=500, check=True)
    expected = 'below the line: if __name__ == "__main__":\n' if by == "-" else "[(0, 1), (1, 2)]\n"
    assert ended.stdout.endswith(expected)


def test_calls_while_the_first_process_starts_wait_for_it() -> None:
    """Regression: a call during the start started the process again, and both calls read one connection."""
    with Workers(1, time.sleep, (0.5,), keep_ready=True) as workers:
        starting = threading.Thread(target=workers.start)
        starting.start()
        time.sleep(0.1)
        assert [workers.submit(abs, -i) for i in range(3)][2].result(300) == 2
        starting.join()


def test_a_process_that_cannot_start_is_said(worker: Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: commands said that their output could not be written; in a worker of a pool, results said AssertionError."""
    for error in (BlockingIOError(11, "Resource temporarily unavailable"), AssertionError("daemonic")):
        start = Mock(side_effect=error)
        monkeypatch.setattr("multiprocessing.context.SpawnProcess.start", start)
        with Workers(1) as pool:
            refuses(r"could not be started: .*(unavailable|daemonic)", list, pool.each(os.getpid, [()]))
        start.assert_called_once()
    monkeypatch.undo()
    assert worker.call(os.getpid) != os.getpid()


def test_a_call_after_the_end_and_a_signal_without_a_name(worker: Worker) -> None:
    """Regressions: the call waited forever; the signal was a ValueError."""
    with Workers(1) as workers:
        pass
    ends("closed", lambda: workers.submit(abs, -3).result(HELD))
    ends("by signal", worker.call, os.kill, worker.call(os.getpid), signal.SIGRTMIN + 1)
