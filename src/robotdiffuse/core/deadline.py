"""Time limit and cancellation of the current call, for slow steps deep inside it such as preparing a
scene."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

LONG = 0.2
"""Steps shorter than this start whenever any time is left [s]."""
_left: ContextVar[Callable[[], float] | None] = ContextVar("left", default=None)
_leave: ContextVar[Callable[[], None] | None] = ContextVar("leave", default=None)


PREPARING, TIMING = "to prepare the scene", "for timing"
"""What a time limit may be too short for."""


class OutOfTimeError(Exception):
    """No time is left for a step; the message names the step."""

    def __init__(self, step: str, what: str = PREPARING) -> None:
        super().__init__(step)
        self.what = what
        """One of PREPARING and TIMING, which the step is part of."""


@contextmanager
def deadline(left: Callable[[], float]) -> Iterator[None]:
    """Within the block, `check_time` uses `left()` as the remaining time [s]."""
    before = _left.set(left)
    try:
        yield
    finally:
        _left.reset(before)


@contextmanager
def left_by(leave: Callable[[], None]) -> Iterator[None]:
    """Within the block, each `check_left` calls `leave`, which may raise an exception to cancel the work.

    A signal handler must not raise it instead: compiled code that returns its results runs Python, where an
    unexpected exception ends the process.
    """
    before = _leave.set(leave)
    try:
        yield
    finally:
        _leave.reset(before)


def check_left() -> None:
    """Raise the exception of `left_by` if the call is cancelled."""
    leave = _leave.get()
    if leave is not None:
        leave()


def check_timing(step: str, seconds: float = 0.0) -> None:
    """`check_time` for a step of timing, which may run up to LONG past the time limit.

    Planners reserve the time that timing took in earlier calls, so it exceeds the limit rarely; then a path
    that was found late is still returned.
    """
    _check(step, seconds, TIMING, LONG)


def check_time(step: str, seconds: float = 0.0) -> None:
    """Raise OutOfTimeError if no time is left, or not enough for a step that takes about `seconds` [s]."""
    _check(step, seconds, PREPARING, 0.0)


def _check(step: str, seconds: float, what: str, late: float) -> None:
    check_left()
    left = _left.get()
    remaining = float("inf") if left is None else left()
    if remaining <= -late:
        raise OutOfTimeError(step, what)
    if seconds > max(LONG, remaining):
        raise OutOfTimeError(f"{step}, which takes about {seconds:.1f} s", what)
