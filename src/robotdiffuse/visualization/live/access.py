"""Access: a proxy in front of viser, which by itself accepts every connection.

The proxy accepts a request if its path begins with the token, or, without a token, if its Host header names
this machine (which stops DNS rebinding). A request with an Origin header must come from this page. Accepted
requests are forwarded to viser on a local port, with a secret header that only the proxy knows.
"""

import asyncio
import hmac
import ipaddress
import secrets
import socket
import threading
from contextlib import suppress
from urllib.parse import urlsplit

from robotdiffuse.core.errors import InputError

SECRET = "X-RobotDiffuse-Secret"
MAX_HEAD_SIZE = 32_768
"""Largest head of a request [bytes]."""
READ_TIMEOUT = 10.0
"""Time for the head of a request to arrive [s]."""
CHUNK_SIZE = 65_536
"""Bytes that are forwarded at once."""


def is_loopback(host: str) -> bool:
    """Whether an address can be reached only from this machine."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on an address. Raises InputError if that is not possible."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError):
        raise InputError(f"--host is {host!r}; it must be an address of this machine") from None
    listening = socket.socket(family, kind, protocol)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(address)
        listening.listen()
    except OSError as error:
        listening.close()
        why = error.strerror or str(error)
        raise InputError(
            f"port {port} of {host} cannot be used: {why}; choose another with --port, or 0 for any"
        ) from None
    return listening


class AccessProxy:
    """Forwards accepted requests from a listening socket to viser, in a thread, until it is closed."""

    def __init__(self, listening: socket.socket, inner_port: int, secret: str, token: str) -> None:
        """secret: added to requests forwarded to `inner_port` on this machine. token: required in paths; if
        empty, the Host header must name this machine."""
        self._listening, self._inner, self._secret, self._token = listening, inner_port, secret, token
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="access", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening and close all connections."""
        with suppress(RuntimeError):  # the loop has already ended
            self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        self._loop.run_until_complete(self._serve())
        self._loop.close()

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._handle, sock=self._listening, limit=MAX_HEAD_SIZE)
        await self._ended.wait()
        server.close()
        others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _handle(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), READ_TIMEOUT)
            passed = accepted_head(head, self._token)
            if passed is None:
                writer.write(REFUSAL)
                await writer.drain()
                return
            request, _, fields = passed.partition(b"\r\n")
            inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self._inner)
            inner_writer.write(request + f"\r\n{SECRET}: {self._secret}\r\n".encode() + fields)
            await asyncio.gather(_forward(reader, inner_writer), _forward(inner_reader, writer))
        except (OSError, EOFError, TimeoutError, asyncio.LimitOverrunError, asyncio.CancelledError):
            pass  # the client disconnected or speaks no HTTP, or the proxy was closed
        finally:
            writer.close()


async def _forward(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while chunk := await reader.read(CHUNK_SIZE):
            writer.write(chunk)
            await writer.drain()
    finally:
        writer.close()


_PAGE = b"The address of this page ends with a token: see what the command printed.\n"
REFUSAL = (
    b"HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain\r\nConnection: close\r\n"
    b"Content-Length: %d\r\n\r\n%s" % (len(_PAGE), _PAGE)
)


def accepted_head(head: bytes, token: str) -> bytes | None:
    """The head of a request to forward, without the token; None if the request is refused."""
    lines = head.decode("latin-1").split("\r\n")
    words = lines[0].split(" ")
    if len(words) != 3 or words[0] != "GET":
        return None
    fields = [line.partition(":") for line in lines[1:] if line]

    def named(name: str) -> list[str]:
        return [value.strip() for field, _, value in fields if field.lower() == name]

    [host, *more], origins = named("host") or [""], named("origin")
    if more or any(k.lower() == SECRET.lower() for k, _, _ in fields):
        return None
    if any(_part(origin, "netloc") != host for origin in origins):
        return None
    path = words[1]
    if token:
        first, slash, rest = path.removeprefix("/").partition("/")
        first, mark, query = first.partition("?")
        if not hmac.compare_digest(first.encode(), token.encode()):
            return None
        path = f"/{rest}" if slash else f"/{mark}{query}"
    elif not is_loopback(_part(f"//{host}", "hostname")):
        return None
    lines[0] = f"GET {path} {words[2]}"
    return "\r\n".join(lines).encode("latin-1")


def _part(url: str, name: str) -> str:
    """A part of a URL; "" if it is not one."""
    try:
        return getattr(urlsplit(url), name) or ""
    except ValueError:
        return ""


def token_for(listening: socket.socket) -> str:
    """A random token for the address of a page; "" if only this machine can reach it."""
    return "" if is_loopback(listening.getsockname()[0]) else secrets.token_urlsafe(16)
