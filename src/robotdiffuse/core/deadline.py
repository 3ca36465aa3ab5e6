"""Time limit and cancellation of the current call, for slow steps deep inside it such as preparing a
scene."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

LONG = 0.2
"""A step shorter than this [s] begins as long as any time is left. Such a step of timing (the time
parameterization) may begin up to this long after the time limit."""
_remaining: ContextVar[Callable[[], float]] = ContextVar("remaining", default=lambda: float("inf"))
_cancel_check: ContextVar[Callable[[], None]] = ContextVar("cancel_check", default=lambda: None)
# Work for which too little time is left; the words end the message "the time limit is too short ...".
PREPARING = "to prepare the scene"
TIMING = "for timing"


class OutOfTimeError(Exception):
    """No time is left for a step; the message names the step."""

    def __init__(self, step: str, what: str = PREPARING) -> None:
        super().__init__(step)
        self.what = what
        """PREPARING or TIMING: the work that the step is part of."""


@contextmanager
def deadline(remaining: Callable[[], float]) -> Iterator[None]:
    """Within the block, `check_time` uses `remaining()` as the remaining time [s]."""
    before = _remaining.set(remaining)
    try:
        yield
    finally:
        _remaining.reset(before)


@contextmanager
def cancel_check(check: Callable[[], None]) -> Iterator[None]:
    """Within the block, each `check_cancelled` calls `check`, which may raise to cancel the work.

    A signal handler must not raise instead: compiled code runs Python while it returns its results, and an
    exception there ends the process.
    """
    before = _cancel_check.set(check)
    try:
        yield
    finally:
        _cancel_check.reset(before)


def check_cancelled() -> None:
    """Raise the exception of `cancel_check` if the call is canceled."""
    _cancel_check.get()()


def check_timing(step: str, seconds: float = 0.0) -> None:
    """`check_time` for a step of timing, which may begin up to LONG after the time limit.

    Planners reserve time for timing (`PlanningContext.search_until`), so timing rarely exceeds the limit. The
    overrun allows a planner to return a path that was found late.
    """
    check_time(step, seconds, TIMING)


def check_time(step: str, seconds: float = 0.0, what: str = PREPARING) -> None:
    """Raise OutOfTimeError if no time is left, or not enough for a step that takes about `seconds` [s]; see
    LONG for short steps. Raises as `check_cancelled` does if the call is canceled.

    what: PREPARING or TIMING, the work that the step is part of.
    """
    check_cancelled()
    remaining = _remaining.get()()
    if remaining <= (-LONG if what == TIMING else 0.0):
        raise OutOfTimeError(step, what)
    if seconds > max(LONG, remaining):
        raise OutOfTimeError(f"{step}, which takes about {seconds:.1f} s", what)
