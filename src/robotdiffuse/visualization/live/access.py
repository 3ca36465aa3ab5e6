"""What stands between the network and the page: viser itself lets in whoever connects.

Requests come here first. Let in are those whose path begins with the token, where there is one; that name the
host as people on this machine do, where only they may come (a page elsewhere whose name was pointed at this
machine does not); and, of those that open the connection through which all goes, those that this very page
made. They are handed on to viser on a port of its own, with a secret that no one else has.
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
LONGEST_HEAD = 32_768
"""Of a request [bytes]."""
PATIENCE = 10.0
"""In which the head of a request has to come [s]."""
PIECE = 65_536


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach it."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def bound(host: str, port: int) -> socket.socket:
    """A socket that listens there; InputError, one line, where that cannot be."""
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
            f"port {port} of {host} cannot be used: {why}; choose another by --port, or 0 for any"
        ) from None
    return listening


class Door:
    """Serves a socket until it is closed."""

    def __init__(self, listening: socket.socket, inner_port: int, secret: str, token: str) -> None:
        """`secret` goes with what is handed on to `inner_port` of this machine; no `token`: none is asked
        for, and only names of this machine are let in."""
        self._listening, self._inner, self._secret, self._token = listening, inner_port, secret, token
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="door", daemon=True)
        self._thread.start()

    def close(self) -> None:
        with suppress(RuntimeError):  # it has ended already
            self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        self._loop.run_until_complete(self._serve())
        self._loop.close()

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._enter, sock=self._listening, limit=LONGEST_HEAD)
        await self._ended.wait()
        server.close()
        others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _enter(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE)
            passed = admitted(head, self._token)
            if passed is None:
                writer.write(REFUSAL)
                await writer.drain()
                return
            request, _, fields = passed.partition(b"\r\n")
            inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self._inner)
            inner_writer.write(request + f"\r\n{SECRET}: {self._secret}\r\n".encode() + fields)
            await asyncio.gather(_pour(reader, inner_writer), _pour(inner_reader, writer))
        except (OSError, EOFError, TimeoutError, asyncio.LimitOverrunError, asyncio.CancelledError):
            pass  # whoever it was has gone, or speaks no HTTP; or the door is closed
        finally:
            writer.close()


async def _pour(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while piece := await reader.read(PIECE):
            writer.write(piece)
            await writer.drain()
    finally:
        writer.close()


_PAGE = b"The address of this page ends with a token: see what `robotdiffuse live` printed.\n"
REFUSAL = (
    b"HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain\r\nConnection: close\r\n"
    b"Content-Length: %d\r\n\r\n%s" % (len(_PAGE), _PAGE)
)


def admitted(head: bytes, token: str) -> bytes | None:
    """The head of a request as it is handed on, without the token; None if it is not let in."""
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
    """Of what may be no URL; then ""."""
    try:
        return getattr(urlsplit(url), name) or ""
    except ValueError:
        return ""


def new_token() -> str:
    return secrets.token_urlsafe(16)
