"""Clients that speak no HTTP, send or read too slowly, or disconnect; found by tests/helpers/fuzz."""

import asyncio
import json
import socket
from http.client import HTTPResponse
from typing import Any

import h11
import httpx
import numpy as np
import pytest

from helpers.box_arm import box_arm

pytest.importorskip("fastapi")

from fastapi import Request
from uvicorn import Config
from uvicorn.server import ServerState

import robotdiffuse as rd
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.server import connection, worker
from robotdiffuse.server.app import JSON, read_body
from robotdiffuse.server.connection import Connection
from robotdiffuse.server.settings import ServeSettings
from robotdiffuse.server.worker_pool import WorkerPool


def answer(server: httpx.Client, sent: bytes) -> tuple[int, Any]:
    """Status code and body of the answer to raw bytes."""
    with socket.create_connection((server.base_url.host, server.base_url.port or 0), 10) as client:
        client.sendall(sent)
        response = HTTPResponse(client, method="HEAD" if sent.startswith(b"HEAD") else "GET")
        response.begin()
        body = response.read()
    return response.status, json.loads(body) if body else None


RIGHT = b"Host: localhost\r\n"
CHUNKED = b"Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n0x5\r\n{}\r\n"
CASES = {
    "a host without its bracket": (b"GET /robots HTTP/1.1\r\nHost: [::1\r\n\r\n", 421, "the host is '[::1'"),
    "no HTTP": (b"hello\r\n\r\n", 400, "not an HTTP/1.1 request"),
    "a huge head": (b"GET / HTTP/1.1\r\n" + RIGHT + b"X: " + b"y" * 100_000, 400, "head is too large"),
    "a slash more": (b"GET /robots/ HTTP/1.1\r\n" + RIGHT + b"\r\n", 404, "there is no '/robots/'"),
    "a damaged chunk": (b"POST /plan HTTP/1.1\r\n" + RIGHT + CHUNKED, 400, "not an HTTP/1.1 request"),
}


@pytest.mark.parametrize(("sent", "code", "message"), CASES.values(), ids=CASES)
def test_what_is_wrong_is_one_line_of_json(server: httpx.Client, sent: bytes, code: int, message: str) -> None:
    given, record = answer(server, sent)
    assert given == code and message in record["error"] and server.get("/health").status_code == 200


def test_a_damaged_chunk_after_head_is_answered_without_a_body(server: httpx.Client) -> None:
    head = b"HEAD /plan HTTP/1.1\r\n" + RIGHT + b"Transfer-Encoding: chunked\r\n\r\n0x5\r\n"
    assert answer(server, head) == (400, None) or answer(server, head) == (405, None)
    assert server.get("/health").status_code == 200


class Transport(asyncio.Transport):
    """Records the bytes written."""

    written = b""
    connection: Connection | None = None

    def write(self, data: Any) -> None:
        assert self.connection is not None
        self.written += data

    def is_closing(self) -> bool:
        return self.connection is None

    def close(self) -> None:
        made = self.connection
        self.connection = None
        if made is not None:
            made.connection_lost(None)

    abort = close


async def slow(scope: Any, receive: Any, send: Any) -> None:
    """An application that answers late."""
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await asyncio.sleep(0.01)
    await send({"type": "http.response.body", "body": b"late"})


async def never(scope: Any, receive: Any, send: Any) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


def talked(application: Any, *sent: bytes, stuck: bool = False) -> tuple[bytes, bool, Any]:
    """The bytes that a connection wrote in 0.2 s after it got these bytes, whether it closed itself, and its state."""

    async def talk() -> tuple[bytes, bool, Any]:
        made = Connection(Config(application, interface="asgi3", lifespan="off", log_level="critical"), ServerState(), {})
        transport = Transport()
        transport.connection = made
        made.connection_made(transport)
        for data in sent:
            made.data_received(data)
            await asyncio.sleep(0.005)
        if stuck:
            made.pause_writing()
        assert application is slow or not transport.is_closing()
        await asyncio.sleep(0.2)
        found = transport.written, transport.is_closing(), made.conn.our_state
        transport.close()
        return found

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
def test_slow_clients_are_answered_and_disconnected(sent: bytes, stuck: bool, expected, monkeypatch) -> None:
    monkeypatch.setattr(connection, "READ_TIMEOUT", 0.05)
    monkeypatch.setattr(connection, "WRITE_TIMEOUT", 0.05)
    start, holds, ends = expected
    written, closed, _ = talked(never, *([sent] if sent else []), stuck=stuck)
    assert closed == ends and written.startswith(start) and holds in written and bool(written) == bool(start)


def test_nothing_is_written_after_a_refusal() -> None:
    """Regression: h11 raised LocalProtocolError for a damaged chunk just before the application answered."""
    written, _, state = talked(slow, b"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n0x5\r\n")
    assert written.startswith(b"HTTP/1.1 400") and b"late" not in written
    assert state in (h11.MUST_CLOSE, h11.CLOSED, h11.DONE)


@pytest.mark.parametrize("head", [b"HTTP/1.0\r\n", b"HTTP/1.1\r\nHost: a\r\nConnection: close\r\n"])
def test_bytes_after_the_last_request_do_not_cut_its_answer_off(head: bytes) -> None:
    """Regression: these bytes were refused as not HTTP, and the connection was closed before the body was written."""
    written, closed, _ = talked(slow, b"POST / " + head + b"Content-Length: 2\r\n\r\n{}]]", b"]]]]")
    assert written.startswith(b"HTTP/1.1 200") and b"late" in written and closed


def test_a_cancelled_call_is_left_before_it_begins_and_when_it_checks_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a call that was canceled while its worker still read it went on planning, and the worker was killed. A signal
    handler raised the exception anywhere in the call; inside a callback of compiled code it killed the worker."""
    worker.accept({}, ServeSettings())
    answers = iter([True])
    monkeypatch.setattr(worker, "cancelled", lambda: next(answers))
    with pytest.raises(worker.Cancelled):
        worker.respond(worker.PLAN, b"{}")
    answers = iter([False, False, True])

    def planning(*_: object) -> worker.Answer:
        call = PlanningContext("aorrtc", rd.Problem(box_arm(), rd.Scene(), np.zeros(3), np.ones(3)))
        while True:
            assert call.remaining > 0

    monkeypatch.setattr(worker, "answer_plan", planning)
    with pytest.raises(worker.Cancelled):
        worker.respond(worker.PLAN, b"{}")


class Piece(bytes):
    """Bytes that count how often the length of any piece is asked for."""

    asked = 0

    def __len__(self) -> int:
        Piece.asked += 1
        return super().__len__()


def test_the_work_for_a_body_in_pieces_grows_with_their_number() -> None:
    """Regression: 20,000 pieces of one byte kept the server busy for 15 s, since it summed all lengths for each."""
    pieces = [Piece(b"x") for _ in range(300)]

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": pieces.pop(), "more_body": bool(pieces)}

    scope = {"type": "http", "method": "POST", "headers": [(b"content-type", JSON.encode())]}
    pool = WorkerPool({}, ServeSettings(max_request_size=300))
    assert asyncio.run(read_body(Request(scope, receive), pool, JSON)) == b"x" * 300
    assert pool.arriving_bytes == 0 and Piece.asked < 3000
