"""Which requests reach the page, and errors for ports and hosts."""

import http.client
import socket

import pytest

from robotdiffuse.core.errors import InputError
from robotdiffuse.visualization.live.access import SECRET, AccessProxy, accepted_head, is_loopback, listen


def request(path: str = "/", **fields: str) -> bytes:
    lines = [f"GET {path} HTTP/1.1", *(f"{name}: {value}" for name, value in fields.items()), "", ""]
    return "\r\n".join(lines).encode()


@pytest.mark.parametrize("host", ["localhost:8080", "127.0.0.1:8080", "[::1]:9000", "localhost"])
def test_names_of_this_machine_are_let_in(host: str) -> None:
    assert accepted_head(request(Host=host), "") == request(Host=host)
    assert accepted_head(request(Host=host, Origin=f"http://{host}"), "")


@pytest.mark.parametrize(
    "head",
    [
        request(Host="evil.example:8080"),  # a name that was pointed here
        request(Host="localhost:8080", Origin="http://evil.example"),
        request(Host="localhost:8080", Origin="http://localhost:9000"),
        request(Host="localhost:8080", Origin="null"),
        request(),
        request(Host="localhost:8080").replace(b"GET", b"POST"),
        request(Host="localhost:8080", **{SECRET.lower(): "guess"}),
        request(Host="localhost:8080\r\nHost: localhost"),
        b"nonsense\r\n\r\n",
    ],
)
def test_others_are_not(head: bytes) -> None:
    assert accepted_head(head, "") is None


def test_elsewhere_the_path_begins_with_the_token() -> None:
    fields = {"Host": "192.0.2.7:8080"}
    assert accepted_head(request("/token", **fields), "token") == request("/", **fields)
    assert accepted_head(request("/token/", **fields), "token") == request("/", **fields)
    assert accepted_head(request("/token/a/b?c=d", **fields), "token") == request("/a/b?c=d", **fields)
    assert accepted_head(request("/token?darkMode", **fields), "token") == request("/?darkMode", **fields)
    for path in ("/", "/tokens", "/toke", "/?token", "//token", "/other/token"):
        assert accepted_head(request(path, **fields), "token") is None
    strange = request("/token", Origin="http://evil.example", **fields)
    assert accepted_head(strange, "token") is None


@pytest.mark.parametrize("wrong", ["[::1", "[::fg]:1", "]", "//[", "127.0.0.1]["])
def test_what_is_no_host_is_not_let_in(wrong: str) -> None:
    """urlsplit raises ValueError for brackets in hosts; found by fuzzing."""
    assert accepted_head(request(Host=wrong), "") is None
    assert accepted_head(request(Host="localhost", Origin=f"http://{wrong}"), "") is None


def test_the_door_hands_on_what_it_lets_in_with_the_secret() -> None:
    inner = socket.create_server(("127.0.0.1", 0))
    listening = listen("127.0.0.1", 0)
    address = listening.getsockname()
    proxy = AccessProxy(listening, inner.getsockname()[1], "secret", "token")
    refused = http.client.HTTPConnection(*address, timeout=10)
    refused.request("GET", "/")
    assert refused.getresponse().status == 403
    guest = http.client.HTTPConnection(*address, timeout=10)
    guest.request("GET", "/token/page")
    connection, _ = inner.accept()
    head = connection.recv(10_000).decode()
    assert head.startswith(f"GET /page HTTP/1.1\r\n{SECRET}: secret\r\n")
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi")
    answer = guest.getresponse()
    assert (answer.status, answer.read()) == (200, b"hi")
    connection.close()
    inner.close()
    proxy.close()
    with pytest.raises(OSError):
        socket.create_connection(address, timeout=1).close()


def test_a_port_that_is_taken_and_a_host_that_is_none() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"port {number} of 127.0.0.1 cannot be used: .*--port"):
            listen("127.0.0.1", number)
    with pytest.raises(InputError, match="--host is 'no such host'"):
        listen("no such host", 0)


def test_loopback() -> None:
    for host, only_here in {"127.0.0.1": True, "::1": True, "localhost": True, "0.0.0.0": False}.items():
        assert is_loopback(host) is only_here
    assert not is_loopback("") and not is_loopback("localhost.example")
