"""Calls shared out over processes of this machine or over a Ray cluster; who hears Ctrl-C, and how they terminate.

Ctrl-C is for the process that a person started: it ends the others. They terminate with it too, even where it is
killed.
"""

import atexit
import fcntl
import logging
import multiprocessing
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NoReturn

from robotdiffuse import __version__
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.registry import AddedEntries, added_entries, adopt_entries

Results = Generator[tuple[int, Any], None, None]
"""Results of calls as they are done, each with the number of its call; to be closed, so that none goes on."""
TERMINATE_TIMEOUT = 5.0
"""Until a process that was told to terminate is killed [s]."""
CONNECT_TIMEOUT = 5.0
"""Until a Ray cluster that does not answer is given up; Ray itself tries for minutes."""
MAX_RETRIES = 20
"""Times that a call is made again on another node of a Ray cluster."""
RERUN_HINT = "give the same command again"


class Workers:
    """Processes of this machine, started when they are first asked and ended when the block is left."""

    def __init__(self, count: int, patience: float = TERMINATE_TIMEOUT) -> None:
        """`count` 0: this process makes the calls itself. `patience`: for those that are stopped [s]."""
        # fresh interpreters: forked ones could inherit locks of running threads
        context = multiprocessing.get_context("spawn")
        self._pool = (
            ProcessPoolExecutor(count, context, prepare_worker, (added_entries(),)) if count else None
        )
        self._count, self._patience = count, patience

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            processes = list((self._pool._processes or {}).values())
            self._pool.shutdown(wait=False, cancel_futures=True)
            terminate(processes, signal.SIGTERM, self._patience)

    def each(self, call: Callable[..., Any], calls: Sequence[tuple]) -> Results:
        """Results of `call(*arguments)` for each of `calls`.

        At most one more than there are processes is under way or waits to be taken. Raises InputError if a
        process is killed from outside, as when memory runs out.
        """
        left, running = list(enumerate(calls))[::-1], {}
        while left and self._pool is None:
            number, arguments = left.pop()
            yield number, call(*arguments)
        try:
            while left or running:
                while self._pool is not None and left and len(running) < self._count + 1:
                    number, arguments = left.pop()
                    with block_interrupts_in_children():
                        running[self._pool.submit(call, *arguments)] = number
                for job in wait(running, return_when=FIRST_COMPLETED).done:
                    yield running.pop(job), job.result()
        except BrokenProcessPool:
            raise InputError(f"a worker process was killed, or could not be started; {RERUN_HINT}") from None


class SingleWorker:
    """A process that makes calls in turn. One that dies of a call costs that call alone: the next has a new
    one."""

    def __init__(self, prepare: Callable[..., None], arguments: tuple) -> None:
        """`prepare(*arguments)` is called once in each process."""
        self._prepare, self._arguments = prepare, arguments
        self._pool: ProcessPoolExecutor | None = None
        self._closed = False

    def call(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """The result of `call(*arguments)` there; what it raises is raised here. Raises BrokenProcessPool if
        the process dies or was closed."""
        return self.submit(call, *arguments).result()

    def submit(self, call: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        """The same, to be waited for."""
        if self._closed:
            raise BrokenProcessPool("closed")
        with block_interrupts_in_children():
            if self._pool is not None:
                with suppress(BrokenProcessPool):
                    return self._pool.submit(call, *arguments)
            context = multiprocessing.get_context("spawn")
            given = added_entries(), self._prepare, self._arguments
            self._pool = ProcessPoolExecutor(1, context, _prepare_lone, given)
            return self._pool.submit(call, *arguments)

    def terminate(self, by: signal.Signals = signal.SIGTERM) -> None:
        """End the process, whatever anybody waits for; the next call has a new one."""
        pool, processes = self._pool, self._processes()
        self._pool = None
        if pool is not None:
            pool.shutdown(wait=False, cancel_futures=True)
            terminate(processes, by, TERMINATE_TIMEOUT)

    def close(self, by: signal.Signals = signal.SIGTERM) -> None:
        """End the process for good."""
        self._closed = True
        self.end(by)

    def _processes(self) -> list[BaseProcess]:
        return list((self._pool._processes or {}).values()) if self._pool is not None else []


def _prepare_lone(entries: AddedEntries, prepare: Callable[..., None], arguments: tuple) -> None:
    prepare_worker(entries)
    prepare(*arguments)


def on_this_machine(call: Callable[..., Any], calls: Sequence[tuple], workers: int) -> Results:
    """As `Workers.each`, by processes for these calls alone."""
    with Workers(min(workers, len(calls))) as pool:
        yield from pool.each(call, calls)


def on_ray(call: Callable[..., Any], calls: Sequence[tuple]) -> Results:
    """The same by a Ray cluster, a core for each call; those of a lost node are made again elsewhere.

    See `ray_cluster`. The nodes need this package, and files at the same places.
    """
    left, running = list(enumerate(calls))[::-1], {}
    with ray_cluster() as ray:
        task = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(_on_node)
        while left or running:
            most = 2 * max(1, int(ray.cluster_resources().get("CPU", 0)))
            while left and len(running) < most:
                number, arguments = left.pop()
                running[task.remote(added_entries(), call, arguments)] = number
            done, _ = ray.wait(list(running), num_returns=1)
            for reference in done:
                yield running.pop(reference), ray.get(reference)


def _on_node(entries: AddedEntries, call: Callable[..., Any], arguments: tuple) -> Any:
    adopt_entries(entries)
    return call(*arguments)


CLUSTERS: dict[str, Callable[[Callable[..., Any], Sequence[tuple]], Results]] = {"ray": on_ray}
"""By the name that --cluster takes."""


def in_order(results: Results) -> Iterator[Any]:
    """The results in the order of the calls."""
    early: dict[int, Any] = {}
    following = 0
    for number, result in results:
        early[number] = result
        while following in early:
            yield early.pop(following)
            following += 1


@contextmanager
def block_interrupts_in_children() -> Iterator[None]:
    """Ctrl-C never reaches processes that are started meanwhile: they inherit the signal mask.

    So it is the parent alone that handles it, even while they are still importing.
    """
    resource_tracker.ensure_running()  # the first process starts it, which would lift the mask again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Ctrl-C takes effect when this is left."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _frame: caught.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if caught:
        signal.raise_signal(signal.SIGINT)


@contextmanager
def exit_on_interrupt(tidy: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Ctrl-C ends this process, after `tidy`, wherever it is: for work that leaves nothing half-done.

    An exception would be lost while compiled code is loaded, whose callbacks swallow it, and mistaken for an
    error of theirs by some packages that are being imported.
    """

    def stop(*_: object) -> None:
        with suppress(Exception):
            tidy()
            print("robotdiffuse: stopped", file=sys.stderr, flush=True)
        os._exit(130)

    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if ignored or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def prepare_worker(entries: AddedEntries) -> None:
    """A worker has what its parent has `added_entries` to the tables, and ends with it, even where that is killed."""
    adopt_entries(entries)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
        _end_by_signal_with(parent)


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


def _end_by_signal_with(parent: BaseProcess) -> None:
    """Linux ends this process when the pipe from its parent closes, by SIGIO, which nothing here waits for:
    a thread has to wait until compiled code and imports let go of the interpreter."""
    pipe = parent.sentinel
    with suppress(OSError, AttributeError):  # systems that cannot have the thread
        fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)


def exit_process(status: int) -> NoReturn:
    """End this process with an exit status, as Python does but for taking the interpreter down, which is a
    twentieth of what a plan by search takes from start to terminate.

    One of several that torchrun started ends at once: threads of PyTorch's process group that want the
    interpreter meanwhile abort the process, rarely, and under load. What it had to do is done by then: files
    are written, others have heard.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        threading._shutdown()  # pyright: ignore[reportAttributeAccessIssue]
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # full, closed, or none since the start
            stream.flush()
    os._exit(status)


def terminate(processes: Iterable[BaseProcess], by: signal.Signals, patience: float) -> None:
    """Send the processes a signal, and kill those that have not ended after `patience` [s]."""
    processes = [process for process in processes if process.is_alive()]
    for process in processes:
        with suppress(ProcessLookupError):  # a pool's own thread may have waited for it by now
            os.kill(process.pid or 0, by)
    until = time.monotonic() + patience
    for process in processes:
        process.join(max(until - time.monotonic(), 0.0))
        if process.is_alive():
            process.kill()
        process.join()


class LineProcess:
    """A program that reads lines and answers with lines. Whatever happens to it, this process lives on.

    It is for one thread at a time; `close` is for any.
    """

    def __init__(self, command: Sequence[str], log: Path) -> None:
        """`log`: what it prints on standard error is added_entries to this file."""
        self._command, self._log = command, log
        self._process: subprocess.Popen[bytes] | None = None
        self._unread = b""
        self._closed = False

    @property
    def runs(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Begin, or begin anew."""
        self._unread = b""
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
                start_new_session=True,  # Ctrl-C is for this process to act on
            )
        if self._closed:  # by another thread, which did not see the new one
            self._process.kill()

    def tell(self, line: str) -> bool:
        """Hand it a line; whether it took it."""
        assert self._process is not None and self._process.stdin is not None
        try:
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            return False
        return True

    def answer(self, patience: float) -> bytes | None:
        """Its next line; None if it ends or says nothing in this time [s]."""
        assert self._process is not None and self._process.stdout is not None
        out, until = self._process.stdout, time.monotonic() + patience
        while b"\n" not in self._unread:
            ready, _, _ = select.select([out], [], [], max(until - time.monotonic(), 0.0))
            part = os.read(out.fileno(), 1 << 20) if ready else b""
            if not part:
                return None
            self._unread += part
        line, _, self._unread = self._unread.partition(b"\n")  # more than one line may be there
        return line

    def ended(self) -> str | None:
        """How it has ended, and the last thing that it printed; None if it had to be killed."""
        assert self._process is not None
        try:
            code = self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return None
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit status {code}"
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return f"{how}: {lines[-1][:300]}" if lines else how

    def close(self) -> None:
        """Kill it, whatever another thread waits for."""
        self._closed = True
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@contextmanager
def ray_cluster() -> Iterator[Any]:
    """The module ray, connected to the cluster that RAY_ADDRESS names, or to one started here with all cores.

    Raises InputError if Ray is not installed, its cluster cannot be reached or fails, and for an InputError
    of a task or a node without this package.
    """
    # read when ray is imported: messages on a lost node are pages long, but for the one on the task
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", "Raylet is terminated")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
        from ray.exceptions import RayError, RayTaskError
    except ImportError:
        raise InputError('a Ray cluster needs ray: pip install "robotdiffuse[cluster]"') from None
    ours = not ray.is_initialized()
    if ours:
        _check_reachable(os.environ.get("RAY_ADDRESS", ""))
    connected = False
    try:
        if ours:
            ray.init(log_to_driver=False, logging_level=logging.CRITICAL)
        connected = True
        yield ray
    except RayTaskError as error:
        if isinstance(error.cause, InputError):
            raise InputError(str(error.cause)) from None
        if "No module named 'robotdiffuse'" in str(error):
            raise InputError(
                f"a node of the Ray cluster cannot import robotdiffuse; install {__version__} on all"
            ) from None
        raise
    except RayError as error:
        raise InputError(f"the Ray cluster failed: {_line(error)}; {RERUN_HINT}") from None
    except (ConnectionError, RuntimeError, ValueError) as error:
        if connected:
            raise
        raise InputError(f"no Ray cluster: {_line(error)}") from None
    finally:
        if ours:
            ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raises InputError if nobody listens where the address HOST:PORT or ray://HOST:PORT says."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_TIMEOUT).close()
    except (OSError, OverflowError) as error:
        raise InputError(f"no Ray cluster at {address}, where RAY_ADDRESS says: {error}") from None


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
