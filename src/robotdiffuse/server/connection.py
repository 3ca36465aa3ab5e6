"""Uvicorn's HTTP/1.1 connection, with errors as one line of JSON and timeouts for slow clients."""

import asyncio
import logging
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from robotdiffuse.core.errors import shown
from robotdiffuse.server.worker import failed

LOG = logging.getLogger("robotdiffuse.server")
READ_TIMEOUT = 10.0
"""Time for a client to send a request [s], from its first byte; for the first request of a connection, from
the connection's start."""
WRITE_TIMEOUT = 60.0
"""Time for a client to read an answer that is waiting for it [s]."""
REFUSED = "refused"
"""Key in the state of a request that the connection itself has answered; the value is the status code."""


def log_access(
    client: tuple[str, int] | None, target: str, code: int, seconds: float, request_id: str = ""
) -> None:
    """Log a line for a request: client, method and path, status code, duration and X-Request-ID."""
    address = f"{client[0]}:{client[1]}" if client else "-"
    LOG.info("%s %s %d %.3f s %s", address, target, code, seconds, shown(request_id) if request_id else "-")


class Connection(H11Protocol):
    """Closes itself when the client stops sending a request or stops reading its answer."""

    _read_timer: asyncio.TimerHandle | None = None
    """Runs until a request is complete."""
    _write_timer: asyncio.TimerHandle | None = None
    """Runs while the write buffer is full."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        if self.conn.their_state is h11.MUST_CLOSE:
            return  # ignore bytes after the client's last request, which still gets its answer
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        for timer in (self._read_timer, self._write_timer):
            if timer is not None:
                timer.cancel()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._write_timer = self.loop.call_later(WRITE_TIMEOUT, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._write_timer is not None:
            self._write_timer.cancel()

    def send_400_response(self, msg: str) -> None:
        """Called by uvicorn for bytes that are not HTTP."""
        self._refuse(400, "not an HTTP/1.1 request, or its head is too large")

    def _watch(self) -> None:
        arriving = self.conn.their_state is h11.SEND_BODY
        if arriving or self.cycle is None or self.cycle.response_complete:
            self._read_timer = self._read_timer or self.loop.call_later(READ_TIMEOUT, self._give_up)
        elif self._read_timer is not None:
            self._read_timer.cancel()
            self._read_timer = None

    def _give_up(self) -> None:
        if self.conn.trailing_data[0] or self.conn.their_state is h11.SEND_BODY:
            self._refuse(408, f"the request took more than {READ_TIMEOUT:g} s to arrive")
        else:
            self.transport.close()

    def _refuse(self, code: int, message: str) -> None:
        """Close the connection; send an error first if no answer has begun."""
        if self.transport.is_closing():
            return
        in_application = self.cycle is not None and not self.cycle.response_complete
        if not in_application:
            log_access(self.client, "-", code, 0.0)
        else:
            self.scope.setdefault("state", {})[REFUSED] = code
            self.cycle.disconnected = True  # tells the application to stop
            self.cycle.message_event.set()
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            answer = failed(code, message).body
            headers = [("Content-Type", "application/json"), ("Content-Length", str(len(answer)))]
            head = h11.Response(status_code=code, headers=[*headers, ("Connection", "close")])
            bodiless = in_application and self.scope["method"] == "HEAD"
            for event in (head, h11.Data(data=b"" if bodiless else answer), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
        self.transport.close()
