"""Worker processes on this machine (each runs one call at a time, and is killed if the call takes too long),
and calls on a Ray cluster.

Only the process that the user started handles Ctrl-C; it ends its workers. Workers also exit when their
parent dies, even if it is killed.
"""

import atexit
import fcntl
import logging
import multiprocessing
import os
import pickle
import queue
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from math import inf
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any
from weakref import WeakSet

from robotdiffuse import __version__
from robotdiffuse.core.errors import InputError, needs
from robotdiffuse.core.interrupts import delay_interrupts
from robotdiffuse.core.registry import AddedEntries, added_entries, adopt_entries

Function = Callable[..., Any]
"""A function that other processes can import: of a module, or a method of an object that can be pickled."""
Results = Generator[tuple[int, Any], None, None]
"""Results in order of completion, each with the index of its call. After it is closed, the generator submits
no more calls. Running calls stop when their processes end; on a cluster, when the connection that was made
for these calls ends."""
TERMINATE_TIMEOUT = 5.0
"""Time from asking a process to end until it is killed [s]."""
PREPARE_TIMEOUT = 600.0
"""Time for a process to prepare, until it is killed [s]."""
CANCEL_TIMEOUT = 1.0
"""Time for a worker to leave a canceled call, until it is killed [s]."""
CHECK_INTERVAL = 0.05
"""Time between two checks whether a call takes too long or is canceled [s]."""
RESTART_DELAY = 1.0
"""Time between two attempts to start a worker that is kept ready [s]."""
MAX_WORKERS = 1024
"""Largest number of worker processes."""
RERUN_HINT = "run the same command again"
GUARD = 'if __name__ == "__main__":'
# fresh interpreters: forked ones could inherit locks of running threads
_SPAWN = multiprocessing.get_context("spawn")


class EndedError(Exception):
    """A worker process ended; the message says how."""


class NotStartedError(EndedError):
    """A worker process ended before its first call; the message says what to change."""


class OverrunError(EndedError):
    """A worker process was killed because its call took too long."""


def check_not_importing() -> None:
    """End this process if it is a worker that still imports the main script, which then lacks GUARD, since it
    starts workers on import. The process that the user started reports it."""
    main = sys.modules["__main__"]
    if main is not sys.modules.get("__mp_main__", main):
        sys.exit(1)


def _check_script() -> None:
    """Raise NotStartedError if the main script is not a file that worker processes can import."""
    main = sys.modules["__main__"]
    script = getattr(main, "__file__", None)
    if main.__spec__ is None and script is not None and not Path(script).is_file():
        raise NotStartedError(
            "worker processes cannot import a script from standard input; save it to a file, and put what it "
            f"does below the line: {GUARD}"
        )


def _not_started() -> NotStartedError:
    """The error for a process that ended before its first call."""
    script = getattr(sys.modules["__main__"], "__file__", None)
    if script is None:
        return NotStartedError("a worker process was killed as it started")
    return NotStartedError(
        f"a worker process could not import the main script {script}, or was killed as it started; put what "
        f"the script does below the line: {GUARD}"
    )


def _nothing() -> None:
    """The preparation of a worker that needs none."""


class Worker:
    """A process that runs one call at a time. It starts with the first call. If it ends during a call, the
    call raises EndedError, and the next call starts a new process."""

    busy = False
    """Whether `Workers` runs a call in it."""

    def __init__(self, prepare: Function = _nothing, arguments: tuple = ()) -> None:
        """`prepare(*arguments)` runs once in each new process. If it returns True, a second process replaces
        this one, for example to load the code that the first has compiled."""
        self._prepare = prepare
        self._arguments = arguments
        self._running: tuple[BaseProcess, Connection] | None = None
        self._starting = threading.Lock()
        """Held while the process starts; if its parent exited then, it would print a traceback."""
        self._number = 0
        """Number of the last call in the process."""
        self._closed = False
        self.ready = False
        """Whether the process is prepared."""

    def start(self) -> None:
        """Start and prepare the process unless it runs.

        Raises NotStartedError if it cannot start, EndedError if it ends while it prepares or is closed.
        """
        if self._running is not None and not self._running[0].is_alive():  # killed between two calls
            self.end()
        if self._running is None and self._start() is True:
            self.end()
            self._start()

    def _start(self) -> object:
        _check_script()
        connection, child_end = _SPAWN.Pipe()
        process = _SPAWN.Process(target=_main, args=(child_end,))
        _started.add(self)
        with delay_interrupts(), self._starting, block_interrupts_in_children():
            if self._closed:  # perhaps just now, by another thread
                raise EndedError("closed")
            try:
                process.start()
            except (AssertionError, OSError) as error:  # in a daemonic process; too many processes
                raise NotStartedError(f"a worker process could not be started: {error}") from None
            child_end.close()
            self._running = (process, connection)
            self._number = 0
        try:
            connection.recv()  # the process has started; only now can it take a call
        except (EOFError, OSError):
            self.end()
            raise EndedError("closed") if self._closed else _not_started() from None
        result = self._ask(pickle.dumps((added_entries(), self._prepare, self._arguments)), PREPARE_TIMEOUT)
        self.ready = True
        return result

    def call(
        self,
        call: Function,
        *arguments: Any,
        timeout: float = inf,
        stop: Callable[[], bool] = lambda: False,
    ) -> Any:
        """The result of `call(*arguments)` in the process; its exceptions are raised here.

        timeout: the process is killed if the call takes longer [s], unless it calls `allow`.
        stop: called every CHECK_INTERVAL; once it returns True, `cancelled` is true in the process, which is
        killed if the call does not end within CANCEL_TIMEOUT.

        Raises EndedError if the process ends or is closed, OverrunError after the timeout or CANCEL_TIMEOUT,
        and NotStartedError if it could not start.
        """
        message = pickle.dumps((call, arguments))
        self.start()
        return self._ask(message, timeout, stop)

    def _ask(self, message: bytes, timeout: float, stop: Callable[[], bool] = lambda: False) -> Any:
        if self._running is None:
            raise EndedError("closed")
        process, connection = self._running
        due = time.monotonic() + timeout
        stop_sent = False
        self._number += 1
        try:
            connection.send((self._number, message))
            while True:
                remaining = due - time.monotonic()
                if remaining <= 0:
                    self.end()
                    raise OverrunError("because its call took too long")
                if not stop_sent and stop():
                    stop_sent = True
                    due = min(due, time.monotonic() + CANCEL_TIMEOUT)
                    connection.send((self._number, None))
                if connection.poll(min(remaining, CHECK_INTERVAL)):
                    answer, renew = connection.recv()
                    if not isinstance(answer, float):
                        break
                    # not a result, but the time that the call may still take, from `allow`; a cancelled call
                    # gets no more
                    if not stop_sent:
                        due = time.monotonic() + answer
        except (EOFError, OSError):
            process.join(TERMINATE_TIMEOUT)
            self.end()
            code = process.exitcode or 0
            names = {number.value: number.name for number in signal.Signals}
            killed_by = names.get(-code, f"signal {-code}")  # most real-time signals have no name
            exit_text = f"by {killed_by}" if code < 0 else f"with exit status {code}"
            raise EndedError("closed" if self._closed else exit_text) from None
        if renew:
            self.end()
        result, error = pickle.loads(answer)
        if error is not None:
            raise error
        return result

    def end(self) -> None:
        """Kill the process, even during a call; the next call starts a new one."""
        end_workers([self], 0.0)

    def close(self) -> None:
        """Kill the process; later calls raise EndedError."""
        self._closed = True
        self.end()


# Workers whose processes may run
_started: "WeakSet[Worker]" = WeakSet()


def end_workers(workers: Iterable[Worker], patience: float) -> None:
    """End the processes of workers together. patience: time from SIGTERM to SIGKILL [s]."""
    processes = []
    for worker in workers:
        with worker._starting:
            running = worker._running
            worker._running = None
        worker.ready = False
        processes += [] if running is None else [running[0]]
    for process in processes:
        if patience > 0:
            process.terminate()
    until = time.monotonic() + patience
    for process in processes:
        process.join(max(until - time.monotonic(), 0.0))
        process.kill()
        process.join()


@atexit.register
def _end_all() -> None:
    for worker in list(_started):
        worker.close()


class Call(Future):
    """The future result of a call that waits for a worker or runs in one."""

    def __init__(self, call: Function, arguments: tuple, timeout: float) -> None:
        super().__init__()
        self._call = call
        self._arguments = arguments
        self._timeout = timeout
        self._stop = False

    def cancel(self) -> bool:
        """Cancel the call. If it runs already, its worker leaves the call or is killed. Returns True if the
        call had not begun."""
        self._stop = True
        return super().cancel()

    def run(self, worker: Worker) -> None:
        """Run the call in a worker, and set its result or exception."""
        if not self.set_running_or_notify_cancel():
            return
        worker.busy = True
        try:
            result = worker.call(self._call, *self._arguments, timeout=self._timeout, stop=lambda: self._stop)
        except BaseException as error:
            worker.busy = False
            self.set_exception(error)
        else:
            worker.busy = False
            self.set_result(result)


class Workers:
    """Worker processes that take calls from one queue, in order. They end at the end of the `with` block."""

    def __init__(
        self,
        count: int,
        prepare: Function = _nothing,
        arguments: tuple = (),
        patience: float = TERMINATE_TIMEOUT,
        keep_ready: bool = False,
    ) -> None:
        """count: processes; 0: `each` runs the calls in this process. prepare, arguments: see `Worker`.
        patience: time from SIGTERM to SIGKILL [s]. keep_ready: start processes before calls need them.

        Raises InputError for more than MAX_WORKERS processes."""
        if count > MAX_WORKERS:
            raise InputError(f"workers is {count}; it must be at most {MAX_WORKERS}")
        if count:
            check_not_importing()
        self.workers = [Worker(prepare, arguments) for _ in range(count)]
        self._patience = patience
        self._keep_ready = keep_ready
        self._calls = queue.SimpleQueue[Call | None]()
        self._threads = list[threading.Thread]()
        self._begun = False
        self._closed = False
        self._not_started: NotStartedError | None = None

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Start to take calls. With `keep_ready`, waits until the first process is prepared, and raises the
        error if that fails; the other processes are prepared in the background."""
        self._begun = True
        if self._keep_ready:
            self.workers[0].start()
        self._threads = [
            threading.Thread(target=self._take_calls, args=(worker,), daemon=True) for worker in self.workers
        ]
        for thread in self._threads:
            thread.start()

    def _take_calls(self, worker: Worker) -> None:
        while not self._closed:
            try:
                if self._keep_ready:
                    worker.start()
            except Exception as error:
                if not self._closed:
                    print(f"a worker could not be started: {error}", file=sys.stderr)
                    time.sleep(RESTART_DELAY)
                continue
            call = self._calls.get()
            if call is None:
                return
            if self._not_started is not None:  # the next process would not start either
                _fail(call, self._not_started)
                continue
            call.run(worker)
            error = None if call.cancelled() else call.exception()
            if isinstance(error, NotStartedError):
                self._not_started = error

    def submit(self, call: Function, *arguments: Any, timeout: float = inf) -> Call:
        """The future of `call(*arguments)` in the next idle process; its exceptions are those of
        `Worker.call`."""
        submitted = Call(call, arguments, timeout)
        if self._closed:
            _fail(submitted, EndedError("closed"))
            return submitted
        if not self._begun:
            self.start()
        self._calls.put(submitted)
        return submitted

    def drop(self, error: Exception) -> None:
        """Let all waiting calls raise `error`."""
        with suppress(queue.Empty):
            while True:
                call = self._calls.get_nowait()
                if call is not None:
                    _fail(call, error)

    def close(self) -> None:
        """End the processes, even during calls; all calls raise EndedError."""
        self._closed = True
        self.drop(EndedError("closed"))
        for worker in self.workers:
            worker._closed = True
        for _ in self._threads:
            self._calls.put(None)
        end_workers(self.workers, self._patience)

    def each(self, call: Function, calls: Sequence[tuple]) -> Results:
        """Results of `call(*arguments)` for each of `calls`.

        The number of calls that run or wait is at most the number of processes plus one. Raises InputError if
        a process cannot be started, ends itself, or is killed from outside, e.g. when memory runs out.
        """
        pending = list(enumerate(calls))[::-1]
        running = {}
        while pending and not self.workers:
            number, arguments = pending.pop()
            yield number, call(*arguments)
        try:
            while pending or running:
                while pending and len(running) < len(self.workers) + 1:
                    number, arguments = pending.pop()
                    running[self.submit(call, *arguments)] = number
                for job in wait(running, return_when=FIRST_COMPLETED).done:
                    yield running.pop(job), job.result()
        except NotStartedError as error:
            raise InputError(str(error)) from None
        except EndedError:
            raise InputError(f"a worker process was killed; {RERUN_HINT}") from None


def _fail(call: Call, error: Exception) -> None:
    if call.set_running_or_notify_cancel():
        call.set_exception(error)


def on_this_machine(call: Function, calls: Sequence[tuple], workers: int) -> Results:
    """`Workers.each` with processes for these calls only; with one worker, the calls run in this process."""
    with Workers(min(workers, len(calls)) if workers > 1 else 0) as pool:
        yield from pool.each(call, calls)


def in_order(results: Results) -> Iterator[Any]:
    """The results in the order of the calls."""
    early = dict[int, Any]()
    following = 0
    for number, result in results:
        early[number] = result
        while following in early:
            yield early.pop(following)
            following += 1


@contextmanager
def block_interrupts_in_children() -> Iterator[None]:
    """Processes started within the block never receive SIGINT, because they inherit the signal mask.

    Only the parent handles Ctrl-C then, even while the children are still importing.
    """
    resource_tracker.ensure_running()  # else starting the first process starts it, which unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# Code that runs in the worker process


class _Process:
    """A worker process, as seen from within."""

    def __init__(self, connection: Connection) -> None:
        self.connection, self.sending = connection, threading.Lock()
        self.calls = queue.SimpleQueue[tuple[int, bytes]]()
        self.running = self.cancelled = 0
        """Numbers that identify the running call, and the last call that was cancelled."""
        self.renew = False

    def send(self, answer: bytes | float) -> None:
        with self.sending:
            self.connection.send((answer, self.renew))

    def receive(self) -> None:
        """Receive calls and cancellations; exit when the parent dies, even if it is killed."""
        with suppress(EOFError, OSError):
            while True:
                number, message = self.connection.recv()
                if message is None:
                    self.cancelled = number
                else:
                    self.calls.put((number, message))
        os._exit(1)

    def run(self) -> None:
        while True:
            self.running, message = self.calls.get()
            try:
                call, arguments = pickle.loads(message)
                answer = pickle.dumps((call(*arguments), None))
            except BaseException as error:
                answer = _failure(error)
            self.send(answer)


_this: _Process | None = None


def _main(connection: Connection) -> None:
    global _this
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Reset "spawn" to the system's default. With "spawn", a lock, such as that of tqdm, is registered with
    # Python's resource tracker, which would warn of it when this process is killed.
    multiprocessing.set_start_method(None, force=True)
    _exit_by_signal_with_parent()
    _this = _Process(connection)
    threading.Thread(target=_this.receive, daemon=True).start()
    try:
        _this.send(0.0)  # the message for which `Worker._start` waits
        _this.running, message = _this.calls.get()
        entries, prepare, arguments = pickle.loads(message)
        adopt_entries(entries)
        _this.send(pickle.dumps((prepare(*arguments), None)))
    except BrokenPipeError:  # the parent has died
        os._exit(1)
    except BaseException:  # it could not run any call
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    _this.run()


def _failure(error: BaseException) -> bytes:
    error.add_note("in a worker process:\n" + "".join(traceback.format_exception(error)))
    try:
        answer = pickle.dumps((None, error))
        pickle.loads(answer)  # fails if the error's constructor takes other arguments
        return answer
    except Exception:
        return pickle.dumps((None, RuntimeError(f"{type(error).__name__}: {error}")))


def _exit_by_signal_with_parent() -> None:
    """Let Linux send SIGIO, which ends this process, when the pipe from its parent closes.

    `_Process.receive` alone is not enough: it waits while compiled code or imports hold the interpreter.
    """
    parent: Any = multiprocessing.parent_process()
    with suppress(OSError, AttributeError):  # other systems have only the thread
        pipe = parent.sentinel
        fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)


def cancelled() -> bool:
    """Whether the call that this worker process runs is cancelled."""
    return _this is not None and _this.cancelled == _this.running


def allow(seconds: float) -> None:
    """Let the call that this worker process runs take `seconds` from now on [s]."""
    if _this is not None:
        _this.send(float(seconds))


def renew() -> None:
    """End this worker process after the call that it runs."""
    if _this is not None:
        _this.renew = True


CONNECT_TIMEOUT = 5.0
"""Time for a Ray cluster to answer [s]; Ray itself would try for minutes."""
MAX_RETRIES = 20
"""Largest number of times that a call is repeated on a Ray cluster after the loss of its node, or after its
process has died."""


def on_ray(call: Function, calls: Sequence[tuple]) -> Results:
    """Run the calls on a Ray cluster, one core each; calls of a lost node or process are repeated.

    See `ray_cluster`. Each node needs this package and, under the same paths, the files that the calls read.
    """
    pending = list(enumerate(calls))[::-1]
    running = {}
    with ray_cluster() as ray:
        task = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(_on_node)
        while pending or running:
            max_running = 2 * max(1, int(ray.cluster_resources().get("CPU", 0)))
            while pending and len(running) < max_running:
                number, arguments = pending.pop()
                running[task.remote(added_entries(), call, arguments)] = number
            finished, _ = ray.wait(list(running), num_returns=1)
            for reference in finished:
                yield running.pop(reference), ray.get(reference)


def _on_node(entries: AddedEntries, call: Function, arguments: tuple) -> Any:
    adopt_entries(entries)
    return call(*arguments)


CLUSTERS: dict[str, Callable[[Function, Sequence[tuple]], Results]] = {"ray": on_ray}
"""Cluster backends by the name that --cluster takes."""


@contextmanager
def ray_cluster() -> Iterator[Any]:
    """The module ray, connected to the cluster at RAY_ADDRESS; without RAY_ADDRESS, to the cluster that was
    last started on this machine, else to a new local one with all cores. A connection that the program has
    already made is used, and kept.

    Raises InputError if Ray is not installed, if its cluster cannot be reached or fails, if a task raises
    InputError, and if a node lacks this package.
    """
    # Ray reads these variables on import. The first hides its page-long messages about a lost node.
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", "Raylet is terminated")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    with needs("ray", "cluster"):
        import ray
        from ray.exceptions import RayError, RayTaskError
    started_here = not ray.is_initialized()
    if started_here:
        _check_reachable(os.environ.get("RAY_ADDRESS", ""))
    try:
        try:
            if started_here:
                ray.init(log_to_driver=False, logging_level=logging.CRITICAL)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(f"no Ray cluster: {error}") from None
        yield ray
    except RayTaskError as error:
        if isinstance(error.cause, InputError):
            raise type(error.cause)(str(error.cause)) from None
        if "No module named 'robotdiffuse'" in str(error):
            raise InputError(
                f"a node of the Ray cluster cannot import robotdiffuse; install {__version__} on every node"
            ) from None
        raise
    except RayError as error:
        raise InputError(f"the Ray cluster failed: {error}; {RERUN_HINT}") from None
    finally:
        if started_here:
            ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raises InputError if nothing listens at the address HOST:PORT or ray://HOST:PORT. Other addresses are
    not checked."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_TIMEOUT).close()
    except (OSError, OverflowError) as error:
        raise InputError(f"no Ray cluster at {address}, the value of RAY_ADDRESS: {error}") from None
