"""A clock that stands still unless a test moves it."""

import time
from types import SimpleNamespace

import pytest


def stop_clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Puts a clock, whose `now` [s] only a test changes, in place of `time.perf_counter`."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(time, "perf_counter", lambda: clock.now)
    return clock
