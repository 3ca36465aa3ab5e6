"""Worker processes on this machine, and how Ctrl-C ends them.

Only the process that the user started handles Ctrl-C; it ends its workers. Workers also exit when their
parent dies, even if it is killed.
"""

import atexit
import fcntl
import multiprocessing
import os
import signal
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

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.registry import AddedEntries, added_entries, adopt_entries

Results = Generator[tuple[int, Any], None, None]
"""Results in order of completion, each with the index of its call. Close the generator to stop the calls."""
TERMINATE_TIMEOUT = 5.0
"""Time from asking a process to end until it is killed [s]."""
RERUN_HINT = "run the same command again"
GUARD = 'if __name__ == "__main__":'


class NotStartedError(BrokenProcessPool):
    """A worker process ended before its first call; the message says what to change."""


def check_not_importing() -> None:
    """End this process if it is a worker that still imports the main script, and the script starts workers on
    import because it lacks GUARD. The process that the user started reports it."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
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
    """A first call, which shows that the process runs."""


class Workers:
    """A pool of local processes, started at the first call and ended at the end of the `with` block."""

    def __init__(self, count: int, patience: float = TERMINATE_TIMEOUT) -> None:
        """count: processes; 0 runs the calls in this process. patience: time from SIGTERM to SIGKILL [s]."""
        if count:
            check_not_importing()
        # fresh interpreters: forked ones could inherit locks of running threads
        context = multiprocessing.get_context("spawn")
        self._pool = (
            ProcessPoolExecutor(count, context, prepare_worker, (added_entries(),)) if count else None
        )
        self._count, self._patience = count, patience
        self._begun: Future[None] | None = None

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            processes = list((self._pool._processes or {}).values())
            self._pool.shutdown(wait=False, cancel_futures=True)
            terminate(processes, signal.SIGTERM, self._patience)

    def each(self, call: Callable[..., Any], calls: Sequence[tuple]) -> Results:
        """Results of `call(*arguments)` for each of `calls`.

        At most one call more than there are processes is running or queued. Raises InputError if a process is
        killed from outside, e.g. when memory runs out.
        """
        left, running = list(enumerate(calls))[::-1], {}
        while left and self._pool is None:
            number, arguments = left.pop()
            yield number, call(*arguments)
        try:
            if self._pool is not None and self._begun is None:
                _check_script()
                with block_interrupts_in_children():
                    self._begun = self._pool.submit(_nothing)
            while left or running:
                while self._pool is not None and left and len(running) < self._count + 1:
                    number, arguments = left.pop()
                    with block_interrupts_in_children():
                        running[self._pool.submit(call, *arguments)] = number
                for job in wait(running, return_when=FIRST_COMPLETED).done:
                    yield running.pop(job), job.result()
        except NotStartedError as error:
            raise InputError(str(error)) from None
        except BrokenProcessPool:
            if self._begun is None or self._begun.exception() is not None:
                raise InputError(str(_not_started())) from None
            raise InputError(f"a worker process was killed; {RERUN_HINT}") from None


class SingleWorker:
    """A worker process that runs one call at a time. If a call kills it, the next call starts a new
    process."""

    def __init__(
        self, prepare: Callable[..., None], arguments: tuple, inherited: tuple[Any, ...] = ()
    ) -> None:
        """`prepare(*arguments, *inherited)` runs once in each new process. inherited: objects that only a
        starting process can receive, such as shared memory."""
        self._prepare, self._arguments, self._inherited = prepare, arguments, inherited
        self._pool: ProcessPoolExecutor | None = None
        self._closed = False

    def call(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """The result of `call(*arguments)` in the process; its exceptions are raised here.

        Raises BrokenProcessPool if the process dies or was closed, NotStartedError if it could not start.
        """
        return self._submit(call, arguments, wait=True).result()

    def submit(self, call: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        """`call` without waiting: the future of its result."""
        return self._submit(call, arguments, wait=False)

    def _submit(self, call: Callable[..., Any], arguments: tuple, wait: bool) -> "Future[Any]":
        """wait: whether to wait until a new process runs before it is sent anything that does not fit a pipe;
        writing to a pipe that nobody reads would block forever."""
        if self._closed:
            raise BrokenProcessPool("closed")
        with block_interrupts_in_children():
            if self._pool is not None:
                with suppress(BrokenProcessPool):
                    return self._pool.submit(call, *arguments)
            _check_script()
            context = multiprocessing.get_context("spawn")
            given = added_entries(), self._inherited
            self._pool = pool = ProcessPoolExecutor(1, context, _begin_single, given)
            begun = pool.submit(_nothing)
        if wait:
            try:
                begun.result()
            except BrokenProcessPool:
                raise _not_started() from None
        pool.submit(_prepare_single, self._prepare, self._arguments)
        return pool.submit(call, *arguments)

    @property
    def ending(self) -> str:
        """How the process ended that the last call was sent to: by a signal or with an exit status."""
        for process in self._processes():
            process.join(TERMINATE_TIMEOUT)
            code = process.exitcode or 0
            return f"by {signal.Signals(-code).name}" if code < 0 else f"with exit status {code}"
        return "by request"

    def terminate(self, by: signal.Signals = signal.SIGTERM) -> None:
        """End the process, even during a call; the next call starts a new one."""
        pool, processes = self._pool, self._processes()
        self._pool = None
        if pool is not None:
            pool.shutdown(wait=False, cancel_futures=True)
            terminate(processes, by, TERMINATE_TIMEOUT)

    def close(self, by: signal.Signals = signal.SIGTERM) -> None:
        """End the process; later calls raise BrokenProcessPool."""
        self._closed = True
        self.terminate(by)

    def _processes(self) -> list[BaseProcess]:
        return list((self._pool._processes or {}).values()) if self._pool is not None else []


_inherited: tuple[Any, ...] = ()
"""What this process, a single worker, received when it started."""


def _begin_single(entries: AddedEntries, inherited: tuple[Any, ...]) -> None:
    global _inherited
    prepare_worker(entries)
    _inherited = inherited


def _prepare_single(prepare: Callable[..., None], arguments: tuple) -> None:
    """Prepare the process; an error ends it, since it could not run any call."""
    try:
        prepare(*arguments, *_inherited)
    except BaseException:
        traceback.print_exc()
        os._exit(1)


def on_this_machine(call: Callable[..., Any], calls: Sequence[tuple], workers: int) -> Results:
    """`Workers.each` with a pool for these calls only."""
    with Workers(min(workers, len(calls))) as pool:
        yield from pool.each(call, calls)


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
    """Processes started within the block never receive SIGINT, because they inherit the signal mask.

    Only the parent handles Ctrl-C then, even while the children are still importing.
    """
    resource_tracker.ensure_running()  # else the first process starts it and unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Delay Ctrl-C until the end of the block."""
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
    """Within the block, Ctrl-C calls `tidy` and exits at once; for work that leaves nothing half-done.

    A KeyboardInterrupt would get lost in callbacks while compiled code is loaded, and some packages mistake
    it for an import error.
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
    """Set up a worker: add the parent's registry entries, and exit when the parent dies, even if it is
    killed."""
    adopt_entries(entries)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_with, args=(parent,), daemon=True).start()
        _exit_by_signal_with(parent)


def _exit_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


def _exit_by_signal_with(parent: BaseProcess) -> None:
    """Let Linux send SIGIO, which ends this process, when the pipe from its parent closes.

    The thread of `_exit_with` alone is not enough: it waits while compiled code or imports hold the
    interpreter.
    """
    pipe = parent.sentinel
    with suppress(OSError, AttributeError):  # other systems have only the thread
        fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)


def exit_process(status: int) -> NoReturn:
    """Exit like Python does, but without tearing down the interpreter, which takes a twentieth of the whole
    time of a `plan` command by search.

    Under torchrun exit handlers are skipped too: under load, threads of PyTorch's process group that need the
    interpreter at that moment rarely abort the process. All files are written by then.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        threading._shutdown()  # pyright: ignore[reportAttributeAccessIssue]
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # the stream is full, closed or None
            stream.flush()
    os._exit(status)


def terminate(processes: Iterable[BaseProcess], by: signal.Signals, patience: float) -> None:
    """Send the signal `by` to the processes, and kill those that still run after `patience` [s]."""
    processes = [process for process in processes if process.is_alive()]
    for process in processes:
        with suppress(ProcessLookupError):  # a thread of the pool may have reaped it by now
            os.kill(process.pid or 0, by)
    until = time.monotonic() + patience
    for process in processes:
        process.join(max(until - time.monotonic(), 0.0))
        if process.is_alive():
            process.kill()
        process.join()
