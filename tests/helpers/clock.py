"""A clock that stands still unless a test moves it."""

import time

import pytest


class Clock:
    """A clock that shows the same time [s] until a test changes it."""

    now = 0.0


def stop_clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Puts a clock that stands still in place of `time.perf_counter`."""
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", lambda: clock.now)
    return clock
