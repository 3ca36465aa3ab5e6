"""The command `robotdiffuse live`."""

import re
import signal
import socket
import subprocess
import sys

import pytest

from helpers.commands import Said

pytest.importorskip("viser", reason="live needs viser: pip install 'robotdiffuse[live]'")
from websockets.exceptions import ConnectionClosed


def test_bad_input_is_one_line(said: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(*words: str) -> str:
        error = said(2, "live", *words)
        assert error.count("\n") == 1, error
        return error

    assert "unknown planner 'best'; known: " in wrong("--planner", "best")
    assert "'99999' is not a port, an integer from 0 to 65535" in wrong("--port", "99999")
    assert "time_limit is 61" in wrong("--time-limit", "61")
    assert "unknown robot 'r2d2'; known: " in wrong("--robot", "r2d2", "--port", "0")
    assert "nowhere.yaml" in wrong("nowhere.yaml", "--port", "0")
    assert "cannot listen on no such host" in wrong("--host", "no such host")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        assert f"cannot listen on 127.0.0.1, port {number}" in wrong("--port", str(number))
    loaded = ("robotdiffuse.cli.live", "robotdiffuse.visualization.live", "viser")
    for module in [name for name in sys.modules if name.startswith(loaded)]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert 'this needs viser, not installed: pip install "robotdiffuse[live]"' in wrong()


def hears(url: str, token: str = "", **fields: str) -> bool:
    """Whether a browser at this address gets data of the page."""
    websockets = pytest.importorskip("websockets.sync.client")
    speaks = [f"viser-v{pytest.importorskip('viser').__version__}"]
    with websockets.connect(f"{url}{token}", subprotocols=speaks, additional_headers=fields) as browser:
        try:
            return bool(browser.recv(timeout=200))
        except ConnectionClosed:
            return False


def test_elsewhere_no_browser_gets_data_without_the_token() -> None:
    command = [sys.executable, "-m", "robotdiffuse", "live", "--host", "0.0.0.0", "--port", "0"]
    server = subprocess.Popen([*command, "--planner", "aorrtc"], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        printed = re.search(r"http://\S+/\?websocket=ws://\S+:(\d+)/([\w-]{20,}) ", server.stdout.readline())
        assert printed is not None
        url = f"ws://127.0.0.1:{printed[1]}/"
        token = printed[2]
        heard = [hears(url, token), hears(url), hears(url, token[:-1]), hears(url, token, Origin="http://evil.example")]
        assert heard == [True, False, False, False]
    finally:
        server.send_signal(signal.SIGTERM)
        assert server.wait(timeout=300) == 143


def test_on_this_machine_pages_of_other_origins_get_no_data() -> None:
    """A web page of another site may find the port; its connection is closed before any data is sent."""
    from robotdiffuse.visualization.live.page import Page
    from robotdiffuse.visualization.live.server import PageServer, free_port
    from robotdiffuse.visualization.live.session import PageOptions, Session, first_problem

    server = PageServer("127.0.0.1", free_port("127.0.0.1", 0))
    page = Page(Session(first_problem(None, None), PageOptions("aorrtc")), server)
    try:
        url = f"ws://127.0.0.1:{server.get_port()}/"
        assert hears(url)
        assert not hears(url, Origin="http://evil.example")
        assert server.request_share_url() is None
    finally:
        page.close()
