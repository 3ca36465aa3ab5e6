"""The server of a page is silent, and what others print is theirs."""

import sys

import pytest

pytest.importorskip("viser", reason="live needs viser: pip install 'robotdiffuse[live]'")

from robotdiffuse.visualization.live import server


def test_viser_is_silent_and_other_threads_print(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """While viser started or stopped, sys.stdout was replaced for all threads: others' output was lost."""
    during = []

    class Server(server._Server):
        def __init__(self, *words: object, **options: object) -> None:
            during.append(sys.stdout)
            super().__init__(*words, **options)  # type: ignore[arg-type]

        def stop(self) -> None:
            during.append(sys.stdout)
            super().stop()

    monkeypatch.setattr(server, "_Server", Server)
    viser_server, _ = server.new_server()
    server.stop_server(viser_server)
    assert during == [sys.stdout, sys.stdout]
    assert capsys.readouterr().out == ""
