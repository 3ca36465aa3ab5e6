"""The command `robotdiffuse live`."""

import http.client
import re
import signal
import socket
import subprocess
import sys
from urllib.parse import urlsplit

import pytest

from robotdiffuse.cli import main

pytest.importorskip("viser", reason="live needs viser: pip install 'robotdiffuse[live]'")


@pytest.fixture
def wrong(capsys: pytest.CaptureFixture[str]):
    def line(*words: str) -> str:
        try:
            status = main(["live", *words])
        except SystemExit as stop:  # of the parser of the command line
            status = stop.code
        error = capsys.readouterr().err
        assert status == 2 and error.count("\n") == 1, error
        return error

    return line


def test_bad_input_is_one_line(wrong, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "unknown planner 'best'; known: " in wrong("--planner", "best")
    assert "'99999' is not a port, an integer from 0 to 65535" in wrong("--port", "99999")
    assert "time_limit is 61" in wrong("--time-limit", "61")
    assert "unknown robot 'r2d2'; known: " in wrong("--robot", "r2d2", "--port", "0")
    assert "nowhere.yaml" in wrong("nowhere.yaml", "--port", "0")
    assert "--host is 'no such host'" in wrong("--host", "no such host")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        assert f"port {number} of 127.0.0.1 cannot be used" in wrong("--port", str(number))
    monkeypatch.delitem(sys.modules, "robotdiffuse.visualization.live.page", raising=False)
    for module in [
        name for name in sys.modules if name.startswith(("robotdiffuse.visualization.live", "viser"))
    ]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "live needs viser: pip install 'robotdiffuse[live]'" in wrong()


def status(url: str, **fields: str) -> int:
    address = urlsplit(url)
    connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=20)
    connection.request("GET", address.path, headers=fields)
    return connection.getresponse().status


def test_elsewhere_nothing_is_served_without_the_token() -> None:
    command = [sys.executable, "-m", "robotdiffuse", "live", "--host", "0.0.0.0", "--port", "0"]
    server = subprocess.Popen([*command, "--planner", "aorrtc"], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        found = re.search(r"http://\S+:(\d+)/([\w-]{20,}) ", server.stdout.readline())
        assert found is not None
        home = f"http://127.0.0.1:{found[1]}"
        assert status(f"{home}/") == 403
        assert status(f"{home}/{found[2][:-1]}/") == 403
        assert status(f"{home}/{found[2]}/") == 200
        assert status(f"{home}/{found[2]}/", Origin="http://evil.example") == 403
    finally:
        server.send_signal(signal.SIGINT)
        assert server.wait(timeout=30) == 130


def test_viser_itself_lets_no_one_in_but_through_the_door() -> None:
    """A page of another site may find viser's own port; its connection is closed before any data is sent."""
    websockets = pytest.importorskip("websockets.sync.client")
    viser = pytest.importorskip("viser")
    from websockets.exceptions import ConnectionClosed

    from robotdiffuse.visualization.live.access import listen
    from robotdiffuse.visualization.live.files import first_problem
    from robotdiffuse.visualization.live.page import Page
    from robotdiffuse.visualization.live.session import PageOptions, Session

    listening = listen("127.0.0.1", 0)
    page = Page(Session(first_problem(None, None), PageOptions("aorrtc")), listening)
    try:
        speaks = [f"viser-v{viser.__version__}"]
        outer, inner = listening.getsockname()[1], page.server.get_port()
        with websockets.connect(f"ws://127.0.0.1:{outer}/", subprotocols=speaks) as guest:
            assert guest.recv(timeout=20)
        stranger = websockets.connect(f"ws://127.0.0.1:{inner}/", subprotocols=speaks)
        with stranger, pytest.raises(ConnectionClosed):
            assert not stranger.recv(timeout=20)
        assert page.server.request_share_url() is None
    finally:
        page.close()
