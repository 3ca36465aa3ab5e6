"""Connections of a server: uvicorn's HTTP/1.1, with errors of one line and bounds of time for clients."""

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from robotdiffuse.server.settings import SENDING, TAKING
from robotdiffuse.server.worker import failed


class Connection(H11Protocol):
    """Closed where a client does not go on with a request, or does not take its answer."""

    _late: asyncio.TimerHandle | None = None
    """Runs while no request is with the application."""
    _stuck: asyncio.TimerHandle | None = None
    """Runs while too much waits to be taken."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        if self.conn.their_state is h11.MUST_CLOSE:
            return  # after a client's last request it has nothing to say, and still gets its answer
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        for timer in (self._late, self._stuck):
            if timer is not None:
                timer.cancel()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._stuck = self.loop.call_later(TAKING, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._stuck is not None:
            self._stuck.cancel()

    def send_400_response(self, msg: str) -> None:
        """Which uvicorn calls for what is not HTTP."""
        self._refuse(400, "this is no request of HTTP/1.1, or its head is too large")

    def _watch(self) -> None:
        if self.cycle is None or self.cycle.response_complete:
            self._late = self._late or self.loop.call_later(SENDING, self._give_up)
        elif self._late is not None:
            self._late.cancel()
            self._late = None

    def _give_up(self) -> None:
        if self.conn.trailing_data[0]:
            self._refuse(408, f"the request took more than {SENDING:g} s to arrive")
        else:
            self.transport.close()

    def _refuse(self, code: int, message: str) -> None:
        """Close the connection, with an error if the answer has not begun."""
        if self.transport.is_closing():
            return
        begun = self.cycle is not None and not self.cycle.response_complete
        if begun:
            self.cycle.disconnected = True  # for the application, which has nothing to say any more
            self.cycle.message_event.set()
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            answer = failed(code, message).body
            headers = [("Content-Type", "application/json"), ("Content-Length", str(len(answer)))]
            head = h11.Response(status_code=code, headers=[*headers, ("Connection", "close")])
            bodiless = begun and self.scope["method"] == "HEAD"
            for event in (head, h11.Data(data=b"" if bodiless else answer), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
        self.transport.close()
