"""The server of a page: which browsers may connect, errors for ports and hosts, and silence."""

import socket
import sys
from typing import Any

import pytest

pytest.importorskip("viser", reason="live needs viser: pip install 'robotdiffuse[live]'")

import viser

from helpers.refusals import refuses
from robotdiffuse.core.network import is_loopback
from robotdiffuse.visualization.live import server as module
from robotdiffuse.visualization.live.server import free_port, may_connect


def test_viser_is_silent_and_other_threads_print(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Regression: while viser started or stopped, sys.stdout was replaced for all threads, and their output was lost."""
    during = []
    for name in ("__init__", "stop"):
        own = getattr(viser.ViserServer, name)

        def watched(*words: Any, own: Any = own, **options: Any) -> None:
            during.append(sys.stdout)
            own(*words, **options)

        monkeypatch.setattr(viser.ViserServer, name, watched)
    module.PageServer("127.0.0.1", module.free_port("127.0.0.1", 0)).stop()
    assert during == [sys.stdout, sys.stdout] and capsys.readouterr().out == ""


HERE = ["localhost:8080", "127.0.0.1:8080", "[::1]:9000", "localhost"]


def test_names_of_this_machine_are_let_in_and_others_are_not() -> None:
    for host, origin in (
        ("evil.example:8080", None),  # a name that was pointed here
        ("localhost:8080", "http://evil.example"),
        ("localhost:8080", "http://localhost:9000"),
        ("localhost:8080", "null"),
        ("", None),
        # urlsplit raises ValueError for brackets in hosts; found by fuzzing
        *((wrong, None) for wrong in ("[::1", "[::fg]:1", "]", "//[", "127.0.0.1][")),
        ("localhost", "http://[::1"),
    ):
        assert all(may_connect("/", here, known, "") for here in HERE for known in (None, f"http://{here}"))
        assert not may_connect("/", host, origin, "")


def test_elsewhere_the_path_is_the_token() -> None:
    host = "192.0.2.7:8080"
    for path in ("/token", "/token/", "/token?darkMode"):
        assert may_connect(path, host, f"http://{host}", "token")
        assert not may_connect(path, host, "http://evil.example", "token")
    for path in ("/", "/tokens", "/toke", "/?token", "/other/token", "/tok\xebn"):
        assert not may_connect(path, host, None, "token")


def test_loopback_ports_that_are_taken_and_hosts_that_are_none() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        refuses(f"cannot listen on 127.0.0.1, port {number}: .*--port", free_port, "127.0.0.1", number)
    refuses("cannot listen on no such host", free_port, "no such host", 0)
    assert all(is_loopback(host) for host in ("127.0.0.1", "::1", "localhost"))
    assert not any(is_loopback(host) for host in ("0.0.0.0", "", "localhost.example"))
