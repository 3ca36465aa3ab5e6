"""How Ctrl-C and other signals end programs, and how they exit."""

import atexit
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, NoReturn

STOPS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
"""Signals that end a program: Ctrl-C, `kill` and batch systems, a terminal that is closed."""


@contextmanager
def handled(handler: Callable[[int, Any], None], *signals: int) -> Iterator[None]:
    """Within the block, signals call the handler, except those that code in C handles and those that are
    ignored, as background jobs ignore Ctrl-C. Signals reach only the main thread; in any other thread, the
    block changes nothing."""
    before = {}
    with suppress(ValueError):  # in another thread
        for number in signals:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, previous_handler in before.items():
            signal.signal(number, previous_handler)


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Delay signals that end the program until the end of the block."""
    caught = list[int]()
    try:
        with handled(lambda number, _: caught.append(number), *STOPS):
            yield
    finally:
        for number in caught:
            signal.raise_signal(number)


def exit_on_interrupt(tidy: Callable[[], None] = lambda: None) -> AbstractContextManager[None]:
    """Within the block, a signal of STOPS calls `tidy` and exits at once, with status 130 after Ctrl-C; for
    work that can stop anywhere.

    The usual KeyboardInterrupt would be lost in callbacks while compiled code is loaded, and some packages
    mistake it for an import error.
    """

    def stop(number: int, _: object) -> None:
        with suppress(Exception):
            tidy()
            print("robotdiffuse: stopped", file=sys.stderr, flush=True)
        os._exit(128 + number)

    return handled(stop, *STOPS)


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

    atexit.register(leave)  # handlers run in reverse order: the first one, this, runs last
    try:
        status = run()
    except SystemExit:  # with a status of its own
        atexit.unregister(leave)
        raise
    if os.environ.get("WORLD_SIZE", "1") != "1":
        leave()
    sys.exit(status)
