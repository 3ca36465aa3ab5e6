"""How Ctrl-C ends programs, and how they exit."""

import atexit
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NoReturn


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


def exit_fast(run: Callable[[], int]) -> NoReturn:
    """Exit with the status of `run()` like Python does, but without tearing down the interpreter, which takes
    a twentieth of the whole time of a `plan` command by search.

    Under torchrun exit handlers are skipped too: under load, threads of PyTorch's process group that need the
    interpreter at that moment rarely abort the process. All files are written by then.
    """
    status = 1

    def leave() -> None:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):  # the stream is full, closed or None
                stream.flush()
        os._exit(status)

    atexit.register(leave)  # the first one registered is called last
    try:
        status = run()
    except SystemExit:  # with a status of its own
        atexit.unregister(leave)
        raise
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        leave()
    sys.exit(status)
