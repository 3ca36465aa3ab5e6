"""Calls shared out over processes of this machine or over a Ray cluster; who hears Ctrl-C, and how they end.

Ctrl-C is for the process that a person started: it ends the others. They end with it too, even where it is
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
import traceback
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
from robotdiffuse.core.registry import Added, added, take_over

Results = Generator[tuple[int, Any], None, None]
"""Results of calls as they are done, each with the number of its call; to be closed, so that none goes on."""
PATIENCE = 5.0
"""Until a process that was told to end is killed [s]."""
CONNECT_SECONDS = 5.0
"""Until a Ray cluster that does not answer is given up; Ray itself tries for minutes."""
LOST_NODES = 20
"""Times that a call is made again on another node of a Ray cluster."""
AGAIN = "give the same command again"
GUARD = 'if __name__ == "__main__":'


class NotStartedError(BrokenProcessPool):
    """A worker process ended before it could make a call; the message says what to change."""


def check_not_importing() -> None:
    """Ends this process if it is a worker that still imports the main script, which starts workers as it is
    imported: it lacks GUARD. The process that a person started says so."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(1)


def _check_script() -> None:
    """Raises NotStartedError if the main script is no file, which worker processes could import."""
    main = sys.modules["__main__"]
    script = getattr(main, "__file__", None)
    if main.__spec__ is None and script is not None and not Path(script).is_file():
        raise NotStartedError(
            "worker processes cannot import a script from standard input; save it to a file, and put what it "
            f"does below the line: {GUARD}"
        )


def _not_started() -> NotStartedError:
    """For a process that ended before its first call."""
    script = getattr(sys.modules["__main__"], "__file__", None)
    if script is None:
        return NotStartedError("a worker process was killed as it started")
    return NotStartedError(
        f"a worker process could not import the main script {script}, or was killed as it started; put what "
        f"the script does below the line: {GUARD}"
    )


def _nothing() -> None:
    """A first call, which shows that a process can make calls."""


class Workers:
    """Processes of this machine, started when they are first asked and ended when the block is left."""

    def __init__(self, count: int, patience: float = PATIENCE) -> None:
        """`count` 0: this process makes the calls itself. `patience`: for those that are stopped [s]."""
        if count:
            check_not_importing()
        # fresh interpreters: forked ones could inherit locks of running threads
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(count, context, prepare_worker, (added(),)) if count else None
        self._count, self._patience = count, patience
        self._begun: Future[None] | None = None

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            processes = list((self._pool._processes or {}).values())
            self._pool.shutdown(wait=False, cancel_futures=True)
            end(processes, signal.SIGTERM, self._patience)

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
            if self._pool is not None and self._begun is None:
                _check_script()
                with interrupts_not_passed_on():
                    self._begun = self._pool.submit(_nothing)
            while left or running:
                while self._pool is not None and left and len(running) < self._count + 1:
                    number, arguments = left.pop()
                    with interrupts_not_passed_on():
                        running[self._pool.submit(call, *arguments)] = number
                for job in wait(running, return_when=FIRST_COMPLETED).done:
                    yield running.pop(job), job.result()
        except NotStartedError as error:
            raise InputError(str(error)) from None
        except BrokenProcessPool:
            if self._begun is None or self._begun.exception() is not None:
                raise InputError(str(_not_started())) from None
            raise InputError(f"a worker process was killed; {AGAIN}") from None


class LoneWorker:
    """A process that makes calls in turn. One that dies of a call costs that call alone: the next has a new
    one."""

    def __init__(
        self, prepare: Callable[..., None], arguments: tuple, inherited: tuple[Any, ...] = ()
    ) -> None:
        """`prepare(*arguments, *inherited)` is called once in each process. `inherited`: what only a process
        that starts can be given, such as shared memory."""
        self._prepare, self._arguments, self._inherited = prepare, arguments, inherited
        self._pool: ProcessPoolExecutor | None = None
        self._closed = False

    def call(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """The result of `call(*arguments)` there; what it raises is raised here. Raises BrokenProcessPool if
        the process dies or was closed, NotStartedError if it could not begin."""
        return self._submit(call, arguments, wait=True).result()

    def submit(self, call: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        """The same, to be waited for."""
        return self._submit(call, arguments, wait=False)

    def _submit(self, call: Callable[..., Any], arguments: tuple, wait: bool) -> "Future[Any]":
        """`wait`: until a process that has to be started has begun, before it is sent anything that would not
        fit a pipe: who writes to a pipe that nobody will read waits for ever."""
        if self._closed:
            raise BrokenProcessPool("closed")
        with interrupts_not_passed_on():
            if self._pool is not None:
                with suppress(BrokenProcessPool):
                    return self._pool.submit(call, *arguments)
            _check_script()
            context = multiprocessing.get_context("spawn")
            given = added(), self._inherited
            self._pool = pool = ProcessPoolExecutor(1, context, _begin_lone, given)
            begun = pool.submit(_nothing)
        if wait:
            try:
                begun.result()
            except BrokenProcessPool:
                raise _not_started() from None
        pool.submit(_prepare_lone, self._prepare, self._arguments)
        return pool.submit(call, *arguments)

    def end(self, by: signal.Signals = signal.SIGTERM) -> None:
        """End the process, whatever anybody waits for; the next call has a new one."""
        pool, processes = self._pool, self._processes()
        self._pool = None
        if pool is not None:
            pool.shutdown(wait=False, cancel_futures=True)
            end(processes, by, PATIENCE)

    def close(self, by: signal.Signals = signal.SIGTERM) -> None:
        """End the process for good."""
        self._closed = True
        self.end(by)

    def _processes(self) -> list[BaseProcess]:
        return list((self._pool._processes or {}).values()) if self._pool is not None else []


_inherited: tuple[Any, ...] = ()
"""What this process, a lone worker, was given as it started."""


def _begin_lone(entries: Added, inherited: tuple[Any, ...]) -> None:
    global _inherited
    prepare_worker(entries)
    _inherited = inherited


def _prepare_lone(prepare: Callable[..., None], arguments: tuple) -> None:
    """An error ends the process: it can make no calls."""
    try:
        prepare(*arguments, *_inherited)
    except BaseException:
        traceback.print_exc()
        os._exit(1)


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
        task = ray.remote(num_cpus=1, max_retries=LOST_NODES)(_on_node)
        while left or running:
            most = 2 * max(1, int(ray.cluster_resources().get("CPU", 0)))
            while left and len(running) < most:
                number, arguments = left.pop()
                running[task.remote(added(), call, arguments)] = number
            done, _ = ray.wait(list(running), num_returns=1)
            for reference in done:
                yield running.pop(reference), ray.get(reference)


def _on_node(entries: Added, call: Callable[..., Any], arguments: tuple) -> Any:
    take_over(entries)
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
def interrupts_not_passed_on() -> Iterator[None]:
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
def interrupts_afterwards() -> Iterator[None]:
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
def interrupts_at_once(tidy: Callable[[], None] = lambda: None) -> Iterator[None]:
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


def prepare_worker(entries: Added) -> None:
    """A worker has what its parent has `added` to the tables, and ends with it, even where that is killed."""
    take_over(entries)
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


def leave(status: int) -> NoReturn:
    """End this process with an exit status, as Python does but for taking the interpreter down, which is a
    twentieth of what a plan by search takes from start to end.

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


def end(processes: Iterable[BaseProcess], by: signal.Signals, patience: float) -> None:
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


class Companion:
    """A program that reads lines and answers with lines. Whatever happens to it, this process lives on.

    It is for one thread at a time; `close` is for any.
    """

    def __init__(self, command: Sequence[str], log: Path) -> None:
        """`log`: what it prints on standard error is added to this file."""
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
        raise InputError(f"the Ray cluster failed: {_line(error)}; {AGAIN}") from None
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
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise InputError(f"no Ray cluster at {address}, where RAY_ADDRESS says: {error}") from None


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
