"""Waits until threads or servers reach a state; a clock that stands still."""

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest


def until(holds: Callable[[], object], patience: float = 300.0, about: Callable[[], object] = lambda: "") -> None:
    """Waits until `holds()`, for at most `patience` [s], for a new machine compiles; the message of a failure is `about()`."""
    end = time.monotonic() + patience
    while not holds():
        assert time.monotonic() < end, about()
        time.sleep(0.005)


def state_when(session: Any, holds: Callable[[Any], object], patience: float = 300.0) -> Any:
    """Waits until the state of a page's session satisfies `holds`; returns the state."""
    until(lambda: holds(session.state), patience, lambda: session.state)
    return session.state


def stop_clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Puts a clock, whose `now` [s] only a test changes, in place of `time.perf_counter`."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(time, "perf_counter", lambda: clock.now)
    return clock
