"""Clients that speak no HTTP, send or read too slowly, or disconnect; found by tests/helpers/fuzz."""

import asyncio
import json
import socket
from typing import Any

import h11
import httpx
import numpy as np
import pytest

from helpers.box_arm import box_arm

pytest.importorskip("fastapi")

from uvicorn import Config
from uvicorn.server import ServerState

from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.server import connection, worker
from robotdiffuse.server.connection import Connection
from robotdiffuse.server.settings import ServeSettings


def answer(server: httpx.Client, sent: bytes) -> tuple[int, Any]:
    """Status code and body of the answer to raw bytes."""
    with socket.create_connection((server.base_url.host, server.base_url.port or 0), 10) as client:
        client.sendall(sent)
        stream = client.makefile("rb")
        code = int(stream.readline().split()[1])
        headers = {}
        while line := stream.readline().strip():
            name, _, value = line.partition(b": ")
            headers[name.lower()] = value
        body = b"" if sent.startswith(b"HEAD") else stream.read(int(headers.get(b"content-length", 0)))
    return code, json.loads(body) if body else None


RIGHT = b"Host: localhost\r\n"
CASES = {
    "a host without its bracket": (b"GET /robots HTTP/1.1\r\nHost: [::1\r\n\r\n", 421, "the host is '[::1'"),
    "no HTTP": (b"hello\r\n\r\n", 400, "not an HTTP/1.1 request"),
    "a huge head": (b"GET / HTTP/1.1\r\n" + RIGHT + b"X: " + b"y" * 100_000, 400, "head is too large"),
    "a slash more": (b"GET /robots/ HTTP/1.1\r\n" + RIGHT + b"\r\n", 404, "there is no '/robots/'"),
    "a damaged chunk": (
        b"POST /plan HTTP/1.1\r\n"
        + RIGHT
        + b"Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n"
        b"0x5\r\n{}\r\n",
        400,
        "not an HTTP/1.1 request",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_one_line_of_json(server: httpx.Client, case: str) -> None:
    sent, code, message = CASES[case]
    given, record = answer(server, sent)
    assert given == code and message in record["error"]
    assert server.get("/health").status_code == 200


def test_a_damaged_chunk_after_head_is_answered_without_a_body(server: httpx.Client) -> None:
    head = b"HEAD /plan HTTP/1.1\r\n" + RIGHT + b"Transfer-Encoding: chunked\r\n\r\n0x5\r\n"
    assert answer(server, head) == (400, None) or answer(server, head) == (405, None)
    assert server.get("/health").status_code == 200


class Transport(asyncio.Transport):
    """Records the bytes written."""

    def __init__(self, connection: Connection) -> None:
        super().__init__()
        self.connection = connection
        self.written = b""
        self.closed = False

    def write(self, data: Any) -> None:
        assert not self.closed
        self.written += data

    def is_closing(self) -> bool:
        return self.closed

    def close(self) -> None:
        if self.closed:
            return
        self.closed = True
        self.connection.connection_lost(None)

    abort = close


def connected(application: Any) -> Connection:
    config = Config(application, interface="asgi3", lifespan="off", log_level="critical")
    return Connection(config, ServerState(), {})


def talked(sent: bytes, monkeypatch: pytest.MonkeyPatch, stuck: bool = False) -> tuple[bytes, bool]:
    """What a connection wrote in the first 0.2 s after these bytes, and whether it closed itself; its
    application never answers."""

    async def never(scope: Any, receive: Any, send: Any) -> None:
        while (await receive())["type"] != "http.disconnect":
            pass

    async def talk() -> tuple[bytes, bool]:
        made = connected(never)
        transport = Transport(made)
        made.connection_made(transport)
        if sent:
            made.data_received(sent)
        if stuck:
            made.pause_writing()
        assert not transport.closed
        await asyncio.sleep(0.2)
        found = transport.written, transport.closed
        transport.close()
        return found

    monkeypatch.setattr(connection, "READ_TIMEOUT", 0.05)
    monkeypatch.setattr(connection, "WRITE_TIMEOUT", 0.05)
    return asyncio.run(talk())


WHOLE = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"


LATE = (b"HTTP/1.1 408", b"took more than 0.05 s", True)


@pytest.mark.parametrize(
    ("sent", "stuck", "expected"),
    [
        (WHOLE[:-5], False, LATE),
        (WHOLE[:-2] + b"Content-Length: 9\r\n\r\n{", False, LATE),
        (b"", False, (b"", b"", True)),
        (WHOLE, False, (b"", b"", False)),
        (WHOLE, True, (b"", b"", True)),
    ],
    ids=["half a head", "half a body", "silence", "being answered", "a client that does not read"],
)
def test_slow_clients_are_answered_and_disconnected(
    sent: bytes, stuck: bool, expected: tuple[bytes, bytes, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    start, holds, ends = expected
    written, closed = talked(sent, monkeypatch, stuck)
    assert closed == ends and written.startswith(start) and holds in written and bool(written) == bool(start)


def test_nothing_is_written_after_a_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    """h11 raised LocalProtocolError for a damaged chunk just before the application answered."""

    async def slow(scope: Any, receive: Any, send: Any) -> None:
        await asyncio.sleep(0.01)
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"late"})

    async def talk() -> Connection:
        made = connected(slow)
        transport = Transport(made)
        made.connection_made(transport)
        made.data_received(b"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n0x5\r\n")
        await asyncio.sleep(0.05)
        assert transport.written.startswith(b"HTTP/1.1 400") and b"late" not in transport.written
        return made

    assert asyncio.run(talk()).conn.our_state in (h11.MUST_CLOSE, h11.CLOSED, h11.DONE)


@pytest.mark.parametrize("head", [b"HTTP/1.0\r\n", b"HTTP/1.1\r\nHost: a\r\nConnection: close\r\n"])
def test_bytes_after_the_last_request_do_not_cut_its_answer_off(head: bytes) -> None:
    """They were refused as not HTTP, and the connection closed before the body was written."""

    async def slow(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await asyncio.sleep(0.01)
        await send({"type": "http.response.body", "body": b"late"})

    async def talk() -> Transport:
        made = connected(slow)
        transport = Transport(made)
        made.connection_made(transport)
        made.data_received(b"POST / " + head + b"Content-Length: 2\r\n\r\n{}]]")
        await asyncio.sleep(0.005)
        made.data_received(b"]]]]")
        await asyncio.sleep(0.05)
        return transport

    ended = asyncio.run(talk())
    assert ended.written.startswith(b"HTTP/1.1 200") and b"late" in ended.written and ended.closed


def test_a_cancelled_call_is_left_before_it_begins_and_when_it_checks_its_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A call cancelled while its worker was still reading it went on planning, and the worker was killed. A
    signal handler raised the exception anywhere in the call; inside a callback of compiled code it killed the
    worker."""
    worker.accept({}, ServeSettings())
    answers = iter([True])
    monkeypatch.setattr(worker, "cancelled", lambda: next(answers))
    with pytest.raises(worker.Cancelled):
        worker.respond(worker.PLAN, b"{}")
    answers = iter([False, False, True])

    def planning(*_: object) -> worker.Answer:
        call = PlanningContext("aorrtc", Problem(box_arm(), Scene(), np.zeros(3), np.ones(3)))
        while True:
            assert call.remaining > 0

    monkeypatch.setattr(worker, "answer_plan", planning)
    with pytest.raises(worker.Cancelled):
        worker.respond(worker.PLAN, b"{}")
