"""How Ctrl-C ends programs, and how they exit."""

import atexit
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import Any, NoReturn


@contextmanager
def handled(handler: Callable[[int, Any], None], *signals: int) -> Iterator[None]:
    """Within the block, signals call the handler. Threads other than the main thread, which signals do not
    reach, change nothing."""
    if threading.current_thread() is not threading.main_thread():
        signals = ()
    before = {number: signal.signal(number, handler) for number in signals}
    try:
        yield
    finally:
        for number, previous_handler in before.items():
            signal.signal(number, previous_handler)


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Delay Ctrl-C until the end of the block."""
    caught: list[int] = []
    with handled(lambda number, _frame: caught.append(number), signal.SIGINT):
        yield
    if caught:
        signal.raise_signal(signal.SIGINT)


def exit_on_interrupt(tidy: Callable[[], None] = lambda: None) -> AbstractContextManager[None]:
    """Within the block, Ctrl-C calls `tidy` and exits with status 130 at once; for work that can stop
    anywhere.

    The usual KeyboardInterrupt would be lost in callbacks while compiled code is loaded, and some packages
    mistake it for an import error.
    """

    def stop(*_: object) -> None:
        with suppress(Exception):
            tidy()
            print("robotdiffuse: stopped", file=sys.stderr, flush=True)
        os._exit(130)

    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    return nullcontext() if ignored else handled(stop, signal.SIGINT)


def exit_fast(run: Callable[[], int]) -> NoReturn:
    """Call `run` and exit with the status that it returns. Exit handlers run, but the interpreter is not torn
    down, which would take 5 % of the time of a `plan` command.

    Under torchrun, exit handlers are skipped as well: threads of PyTorch's process group, which call Python
    during the exit, would sometimes abort the process under load. All files are written by then.
    """
    status = 1

    def leave() -> None:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):  # the stream is full, closed or None
                stream.flush()
        os._exit(status)

    atexit.register(leave)  # handlers run in reverse order, so this one runs last
    try:
        status = run()
    except SystemExit:  # with a status of its own
        atexit.unregister(leave)
        raise
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        leave()
    sys.exit(status)
