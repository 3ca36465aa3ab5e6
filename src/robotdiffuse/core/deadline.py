"""The time that a call has left, for steps far below it that may take longer: the preparation of a scene,
timing. And whether anybody still waits for it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

LONG = 0.2
"""Steps that are shorter are begun with any time that is left [s]."""
_left: ContextVar[Callable[[], float] | None] = ContextVar("left", default=None)
_leave: ContextVar[Callable[[], None] | None] = ContextVar("leave", default=None)


PREPARING, TIMING = "to prepare the scene", "for timing"
"""What a time limit may be too short for."""


class OutOfTimeError(Exception):
    """Which step there was no time for, in words."""

    def __init__(self, step: str, what: str = PREPARING) -> None:
        super().__init__(step)
        self.what = what
        """One of PREPARING and TIMING, which the step is part of."""


@contextmanager
def deadline(left: Callable[[], float]) -> Iterator[None]:
    """`check_time` holds by what `left` says [s] while this lasts."""
    before = _left.set(left)
    try:
        yield
    finally:
        _left.reset(before)


@contextmanager
def left_by(leave: Callable[[], None]) -> Iterator[None]:
    """`leave` is called when a call within this looks at its clock, and may raise something to end it.

    A signal's handler may not: compiled code that hands its results over runs Python, where an exception
    that it does not expect ends the process.
    """
    before = _leave.set(leave)
    try:
        yield
    finally:
        _leave.reset(before)


def check_left() -> None:
    """Raises what `left_by` has, if the call is to be left."""
    leave = _leave.get()
    if leave is not None:
        leave()


def check_timing(step: str, seconds: float = 0.0) -> None:
    """`check_time` for a step of timing. A path in hand is timed until LONG after the end of the time: its
    planner kept so much back for it as that took of late."""
    _check(step, seconds, TIMING, LONG)


def check_time(step: str, seconds: float = 0.0) -> None:
    """Raises OutOfTimeError where the time of a deadline has run out before a step, or will before the end of
    one that is long: it takes about so many seconds."""
    _check(step, seconds, PREPARING, 0.0)


def _check(step: str, seconds: float, what: str, late: float) -> None:
    check_left()
    left = _left.get()
    remaining = float("inf") if left is None else left()
    if remaining <= -late:
        raise OutOfTimeError(step, what)
    if seconds > max(LONG, remaining):
        raise OutOfTimeError(f"{step}, which takes about {seconds:.1f} s", what)
