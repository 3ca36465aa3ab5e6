"""The server of a page is silent, and what others print is theirs."""

import sys
from typing import Any

import pytest

pytest.importorskip("viser", reason="live needs viser: pip install 'robotdiffuse[live]'")

import viser

from robotdiffuse.visualization.live import server


def test_viser_is_silent_and_other_threads_print(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """While viser started or stopped, sys.stdout was replaced for all threads: others' output was lost."""
    during = []
    start, stop = viser.ViserServer.__init__, viser.ViserServer.stop

    def watched_start(self: Any, *words: Any, **options: Any) -> None:
        during.append(sys.stdout)
        start(self, *words, **options)

    def watched_stop(self: Any) -> None:
        during.append(sys.stdout)
        stop(self)

    monkeypatch.setattr(viser.ViserServer, "__init__", watched_start)
    monkeypatch.setattr(viser.ViserServer, "stop", watched_stop)
    server.PageServer("127.0.0.1", server.free_port("127.0.0.1", 0)).stop()
    assert during == [sys.stdout, sys.stdout]
    assert capsys.readouterr().out == ""
