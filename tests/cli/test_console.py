"""Terminal output of commands."""

import sys
import threading
import time

import pytest
import rich.console

from robotdiffuse.cli import console
from robotdiffuse.core.loading import compiled


def test_a_log_says_what_is_compiled(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """Without a terminal, `demo` was silent for a minute and a half on a new machine."""
    monkeypatch.setattr(console, "SPINNER_DELAY", 0.0)
    monkeypatch.setattr(console, "LOG_INTERVAL", 0.01)
    with console.Spinner("planning"):
        compiled.append("search")
        said = ""
        while "\n" not in said:
            time.sleep(0.01)
            said += capsys.readouterr().err
    assert said.splitlines()[0] == "planning: compiling, once on this machine; 1 functions so far (search)"


def test_a_spinner_that_ends_as_it_appears_gives_stdout_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan of two seconds printed its result to standard error: rich had replaced sys.stdout for good."""
    ending = threading.Event()
    stop = console.Spinner.stop

    class Terminal(rich.console.Console):
        def __init__(self, **_: object) -> None:
            ending.wait()
            super().__init__(stderr=True, force_terminal=True)

    def begin_to_stop(spinner: console.Spinner) -> None:
        ending.set()
        stop(spinner)

    monkeypatch.setattr(console.Spinner, "stop", begin_to_stop)
    monkeypatch.setattr(console, "SPINNER_DELAY", 0.0)
    monkeypatch.setattr(rich.console, "Console", Terminal)
    before = sys.stdout
    with console.Spinner("planning"):
        pass
    assert sys.stdout is before


def test_progress_without_a_terminal_is_a_line_at_once(capsys: pytest.CaptureFixture) -> None:
    """`data check` of a few motions said nothing for 25 s."""
    with console.progress("checking motions") as update:
        update(0, 4)
        assert capsys.readouterr().err == "checking motions: 0 of 4\n"
        update(4, 4)
    assert capsys.readouterr().err == ""
