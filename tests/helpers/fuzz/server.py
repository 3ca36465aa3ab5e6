"""The kind `socket`: damaged requests to a running `robotdiffuse serve`, over its socket.

Each is answered within LIMIT, with errors as one line of JSON, or was never complete and the connection is closed. From time to
time, a valid request gets the same answer as at first, and the server then holds nothing further and no more memory.
"""

import atexit
import json
import os
import re
import socket
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from http.client import HTTPException, HTTPResponse
from pathlib import Path as FilePath
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from helpers.fuzz.examples import JOINTS, PROBLEM
from helpers.serving import serving

CLIENT_TIMEOUT = 0.5
"""The server waits so long for a request, and for the next one of a connection [s]."""
LIMIT = 12.0
"""Most wall time until an answer is there or the connection is closed [s], with the time limit of the call and its grace."""
START_LIMIT = 60.0
"""The same for the first requests, which load compiled code [s]."""
INPUTS_BETWEEN_CHECKS = 50
"""Number of inputs between two checks of the server, on average."""
MAX_MEMORY_GROWTH = 48 * 2**20
"""Largest growth of the memory of the server and its workers since the first checks [bytes]."""
SETTLING_CHECKS = 3
"""Checks before memory must stop growing."""
TOKEN = "open sesame"
METHODS = [
    *b"GET POST PUT DELETE HEAD OPTIONS TRACE CONNECT PATCH PRI get \0 \xff".split(b" "),
    *(b"", b"PO ST", b"P" * 5000, b"GET / HTTP/1.1\r\n\r\nPOST"),
]
TARGETS = [
    *b"/ /plan /verify /batch /robots /health /metrics /docs /openapi.json".split(),
    *b"/plan/ //plan /PLAN /%70lan /plan%00 /plan%2f..%2frobots /%ff%fe /% /%zz /requests/".split(),
    *b"/requests/x /requests/%0d%0aX: /requests/a/b /plan?x=1&x=%00#f /../../etc/passwd *".split(),
    *b"/..%5c..%5c plan http://localhost/plan http://[::1 http://evil.example/robots localhost:80".split(),
    *(b"", b"/a b", b"/\xc3\xa9", b"/" + b"a" * 70_000, b"/requests/" + b"%F0%9F" * 500),
]
VERSIONS = [*b"HTTP/1.0 HTTP/0.9 HTTP/2.0 HTTP/1.9 http/1.1 HTTP/\xff".split(), b"", b"HTTP/1.1 x"]
VALUES = [
    *b"x \xff\xfe -1 +5 0x10 1e3 0 chunked close upgrade 100-continue text/plain websocket h2c */*".split(),
    *b"application/x-ndjson evil.example localhost [::1 [::1]:x 127.0.0.1:99999999 a@localhost".split(),
    *(b"", b" ", b"\t", b"5, 5", b"gzip, chunked", b"chunked, identity", b"a" * 20_000, b"9" * 5000),
    *(b"application/json; charset=utf-16", b"multipart/form-data; boundary=", b"a\0b", b"a\rb", b"a\n b"),
    *(b"Bearer", b"Bearer x", b"Basic eDp5", b"Bearer \xc3\xa9"),
]
NAMES = [
    *b"Host Content-Length Content-Type Transfer-Encoding Authorization X-Request-ID Expect Range".split(),
    *b"Connection Upgrade Origin Cookie Content-Encoding Trailer \xff : Host\0".split(),
    *(b"", b"a b", b"X" * 3000, b"Content-Length "),
]
SIZES = [*b"-1 ffffffffffffffffff x 0 5;a=b 0x5 7fffffff".split(), b"", b"5 ", b"1" * 5000]


@dataclass
class Draft:
    """The parts of a request before it is sent."""

    method: bytes
    target: bytes
    body: bytes = b""
    kind: bytes = b"application/json"
    version: bytes = b"HTTP/1.1"
    headers: list[tuple[bytes, bytes]] = field(default_factory=list)
    chunks: list[tuple[bytes, bytes]] | None = None
    """Sizes as they are written, and what follows them."""

    def __post_init__(self) -> None:
        self.headers += [(b"Host", b"127.0.0.1"), (b"Authorization", b"Bearer " + TOKEN.encode())]
        if self.body:
            self.headers += [(b"Content-Type", self.kind), (b"Content-Length", b"%d" % len(self.body))]

    @property
    def written(self) -> bytes:
        lines = [b" ".join((self.method, self.target, self.version)), *(b": ".join(h) for h in self.headers)]
        body = self.body
        if self.chunks is not None:
            body = b"".join(size + b"\r\n" + part + b"\r\n" for size, part in self.chunks)
        return b"\r\n".join(lines) + b"\r\n\r\n" + body


class Answer(NamedTuple):
    status: int
    kind: bytes
    body: bytes


class WrongError(AssertionError):
    """The server did something that it must not do."""


def draft(rng: np.random.Generator, what: str, body: bytes, other: bytes) -> Draft:
    """A complete request, usually to plan or to verify; batches contain both bodies."""
    which = rng.integers(10)
    if which < 5:
        return Draft(b"POST", b"/" + what.encode(), body)
    if which < 8:
        lines = [body.replace(b"\n", b" "), other][:: 1 if rng.random() < 0.5 else -1]
        lines += [b"", b"{}", b"\xff", b"[" * 3000][: rng.integers(5)]
        return Draft(b"POST", b"/batch", b"\n".join(lines), b"application/x-ndjson")
    if which == 8:
        return Draft(b"DELETE", b"/requests/" + (b"x", b"%00", b"mine", b"a" * 200)[rng.integers(4)])
    return Draft(b"GET", TARGETS[rng.integers(9)])


def damage(rng: np.random.Generator, one: Draft) -> None:
    """Makes one change in the request's first line, headers or framing."""
    action = rng.integers(10)
    at = int(rng.integers(len(one.headers) + 1))
    name, value = (of[rng.integers(len(of))] for of in (NAMES, VALUES))
    if action == 0:
        one.method = METHODS[rng.integers(len(METHODS))]
    elif action == 1:
        one.target = TARGETS[rng.integers(len(TARGETS))]
    elif action == 2:
        one.version = VERSIONS[rng.integers(len(VERSIONS))]
    elif action == 3:
        one.headers.insert(at, (name, value))
    elif action == 4 and at < len(one.headers):
        one.headers[at] = (one.headers[at][0], value)
    elif action == 5 and at < len(one.headers):
        del one.headers[at]
    elif action == 6:
        one.headers += [(b"X-%d" % i, b"y" * int(rng.integers(1, 300))) for i in range(rng.integers(1, 2000))]
    elif action == 7:
        length = max(0, len(one.body) + int(rng.integers(-20, 20)))
        one.headers = [h for h in one.headers if h[0] != b"Content-Length" or rng.random() < 0.2]
        one.headers.append((b"Content-Length", b"%d" % length))
    elif action == 8:
        one.headers += [(b"Connection", b"Upgrade"), (b"Upgrade", (b"websocket", b"h2c", b"TLS/1.2")[rng.integers(3)])]
        one.headers += [(b"Sec-WebSocket-Key", b"AAAAAAAAAAAAAAAAAAAAAA=="), (b"Sec-WebSocket-Version", b"13")]
    else:
        _chunk(rng, one)


def _chunk(rng: np.random.Generator, one: Draft) -> None:
    """Send the body in chunks, whose sizes may be wrong."""
    one.headers = [h for h in one.headers if h[0] != b"Content-Length" or rng.random() < 0.1]
    one.headers.append((b"Transfer-Encoding", b"chunked"))
    cuts = np.sort(rng.integers(0, len(one.body) + 1, rng.integers(1, 6))).tolist()
    parts = [one.body[a:b] for a, b in zip([0, *cuts], [*cuts, len(one.body)], strict=True)]
    one.chunks = [(b"%x" % len(part), part) for part in parts if part] + [(b"0", b"")]
    if rng.random() < 0.6:
        i = int(rng.integers(len(one.chunks)))
        one.chunks[i] = (SIZES[rng.integers(len(SIZES))], one.chunks[i][1])
    if rng.random() < 0.1:
        one.chunks[-1:] = [(b"0", b"X-Trailer: 1\r\n")]


class Sent(NamedTuple):
    """How a request is sent."""

    pieces: list[bytes]
    answers: int
    """How many the client waits for."""
    leaves: bool
    """The client closes the connection without waiting."""
    cancels: bytes
    """Name of the request, which another connection cancels meanwhile."""
    head: bool
    """Answers may have no body."""


def sent(rng: np.random.Generator, one: Draft, damaged: Any) -> Sent:
    whole = rng.random() < 0.15
    for _ in range(0 if whole else rng.integers(0, 4)):
        damage(rng, one)
    name = b""
    answers = 1
    way = rng.integers(20)
    if way == 0:
        name = (b"mine", b"\xc3\xa9", b"a b", b"x" * 150)[rng.integers(4)]
        one.headers.append((b"X-Request-ID", name))
    content = one.written
    if not whole and rng.random() < 0.25:
        content = damaged(rng, content)
    pieces = [content]
    if 1 <= way <= 3:
        cuts = np.sort(rng.integers(0, len(content) + 1, rng.integers(1, 5))).tolist()
        pieces = [content[a:b] for a, b in zip([0, *cuts], [*cuts, len(content)], strict=True)]
    elif way in (4, 5, 6):
        pieces = [content[: rng.integers(len(content) + 1)]]
    elif way in (7, 8):
        answers = int(rng.integers(2, 5))
        pieces = [content * answers]
    head = one.method == b"HEAD" or b"HEAD" in content[:200]
    return Sent(pieces, 1 if head else answers, way in (4, 5, 9), name, head)


def exchange(address: tuple[str, int], sent: Sent) -> str:
    """The error in the last answer; "" without one. Raises WrongError if an answer is wrong or late."""
    until = time.monotonic() + LIMIT
    with socket.create_connection(address, LIMIT) as client:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            for piece in sent.pieces:
                client.sendall(piece)
                time.sleep(0.002 * (len(sent.pieces) > 1))
        except OSError:
            pass  # an answer may have come before all was sent
        if sent.leaves:
            return "the client closed the connection"
        if sent.cancels:
            cancel = Draft(b"DELETE", b"/requests/" + b"".join(b"%%%02x" % byte for byte in sent.cancels))
            exchange(address, Sent([cancel.written], 1, False, b"", False))
        stream = client.makefile("rb")
        said = ""
        for _ in range(sent.answers):
            answer = _read(client, stream, until, sent.head)
            if answer is None:
                return said or "closed"
            said = _checked(answer, sent.head)
        return said


def _checked(answer: Answer, head: bool) -> str:
    """The error in an answer; "" for none."""
    if not (200 <= answer.status < 300 or 400 <= answer.status < 500 or answer.status == 503):
        raise WrongError(f"{answer.status} {answer.body[:200]!r}")
    if head or (answer.status == 200 and answer.kind.startswith(b"text/")):
        return ""
    if answer.status == 200 and answer.kind == b"application/x-ndjson":
        return [_error(json.loads(line)) for line in answer.body.splitlines()][-1]
    if answer.kind != b"application/json":
        raise WrongError(f"{answer.status} with {answer.kind!r}: {answer.body[:200]!r}")
    said = _error(json.loads(answer.body))
    if answer.status >= 400 and not said:
        raise WrongError(f"{answer.status} without an error: {answer.body[:200]!r}")
    return said


def _error(record: Any) -> str:
    if not isinstance(record, dict) or "error" not in record:
        return ""
    text = record["error"]
    if not text or "\n" in text or len(text) > 1000 or "Traceback" in text:
        raise WrongError(f"no line: {text[:300]!r}")
    return text


def _read(client: socket.socket, stream: Any, until: float, head: bool) -> Answer | None:
    """The next answer; None if the connection is closed before an answer begins."""
    client.settimeout(max(until - time.monotonic(), 0.001))
    # more answers may come from the stream, which HTTPResponse would close
    open_stream = SimpleNamespace(read=stream.read, readline=stream.readline, readinto=stream.readinto, close=lambda: None)
    response = HTTPResponse(SimpleNamespace(makefile=lambda _: open_stream), method="HEAD" if head else None)  # type: ignore
    try:
        response.begin()
        return Answer(response.status, response.headers.get("Content-Type", "").encode(), response.read())
    except TimeoutError:
        raise WrongError(f"no answer within {LIMIT:g} s") from None
    except ConnectionError:
        return None
    except (ValueError, HTTPException) as error:
        raise WrongError(f"no HTTP: {error}") from None


class Server:
    """`robotdiffuse serve` in a separate process, which ends with this one."""

    def __init__(self, plan: dict[str, Any], path: dict[str, Any]) -> None:
        """`plan`: a good request; `path`: a path for its problem."""
        self.log = tempfile.TemporaryFile()  # noqa: SIM115, for as long as the process
        sizes = ("--workers", "1", "--max-time-limit", "1", "--max-request-size", "1")
        environment = {"ROBOTDIFFUSE_TOKEN": TOKEN, "CLIENT_TIMEOUT": str(CLIENT_TIMEOUT)}
        stack = ExitStack()
        atexit.register(stack.close)
        client, self.process = stack.enter_context(serving(*sizes, stderr=self.log, **environment))
        self.address = client.base_url.host, client.base_url.port or 0
        self.good = Draft(b"POST", b"/plan", json.dumps(plan).encode())
        self.held = self.checks = self.read = 0
        first = {"problem": plan["problem"], "path": path}, {"problem": plan["problem"]}
        for target, body in zip((b"/verify", b"/plan"), first, strict=True):  # to load what is compiled
            self.answer(Draft(b"POST", target, json.dumps(body).encode()), START_LIMIT)
        self.expected = json.loads(self.answer(self.good, START_LIMIT))["waypoints"]

    def answer(self, one: Draft, seconds: float = LIMIT) -> bytes:
        """Send a good request and return the body of its answer."""
        with socket.create_connection(self.address, seconds) as client:
            client.sendall(one.written)
            answer = _read(client, client.makefile("rb"), time.monotonic() + seconds, False)
        if answer is None or answer.status != 200:
            raise WrongError(f"{one.target!r} is answered with {answer and answer[:3]}")
        return answer.body

    def check(self) -> None:
        """Raises WrongError unless the server is alive, answers correctly and uses no more memory than at first."""
        if self.process.poll() is not None:
            raise WrongError(f"the server ended with {self.process.returncode}")
        if json.loads(self.answer(self.good))["waypoints"] != self.expected:
            raise WrongError("a good request has another answer")
        until = time.monotonic() + LIMIT
        state = {}
        while time.monotonic() < until:
            state = json.loads(self.answer(Draft(b"GET", b"/health")))
            if state["workers_busy"] == state["requests_waiting"] == 0:
                break
            time.sleep(0.05)
        else:
            raise WrongError(f"requests are left over: {state}")
        if len(os.listdir(f"/proc/{self.process.pid}/fd")) > 100:
            raise WrongError("connections are left over")
        self.log.seek(self.read)
        written = self.log.read().decode(errors="replace")
        self.read = self.log.tell()
        lines = [line for line in written.splitlines() if not re.search(r" \d{3} \d+\.\d{3} s ", line)]
        if lines:
            raise WrongError(f"the server's log has {lines[-1]}")
        self.checks += 1
        held = _memory(self.process.pid)
        if self.checks <= SETTLING_CHECKS:
            self.held = held
        if held > self.held + MAX_MEMORY_GROWTH:
            raise WrongError(f"memory grew from {self.held >> 20} to {held >> 20} MB")


def _memory(pid: int) -> int:
    """The memory of a process and its children [bytes]."""
    children = FilePath(f"/proc/{pid}/task/{pid}/children").read_text().split()
    pages = [int(FilePath(f"/proc/{each}/statm").read_text().split()[1]) for each in (pid, *children)]
    return sum(pages) * os.sysconf("SC_PAGE_SIZE")


@cache
def running_server() -> Server:
    """The server, which the first call starts; it ends with this process."""
    problem = PROBLEM | {"scene": PROBLEM["scene"][:2]}
    path = {"joint_names": JOINTS, "positions": [problem["start"], problem["goal"]["joints"]]}
    return Server({"problem": problem, "planner": "rrt_connect", "time_limit": 1.0}, path)
