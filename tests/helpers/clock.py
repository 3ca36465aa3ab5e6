"""A clock that stands still unless a test moves it."""

import time

import pytest


class Clock:
    """The time [s]."""

    now = 0.0


def stop_clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Put a still clock in place of `time.perf_counter`."""
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", lambda: clock.now)
    return clock
