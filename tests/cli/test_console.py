"""Terminal output of commands."""

import time

import pytest

from robotdiffuse.cli import console
from robotdiffuse.core.loading import compiled


def test_a_log_says_what_is_compiled(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """Without a terminal, `demo` was silent for a minute and a half on a new machine."""
    monkeypatch.setattr(console, "SPINNER_DELAY", 0.0)
    monkeypatch.setattr(console, "LOG_INTERVAL", 0.01)
    with console.Spinner("planning"):
        compiled.append("search")
        time.sleep(0.5)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "planning: compiling, once on this machine; 1 functions so far (search)"
