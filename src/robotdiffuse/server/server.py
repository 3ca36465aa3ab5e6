"""Starts, runs and stops the server."""

import asyncio
import logging
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import uvicorn

from robotdiffuse.core.network import listening
from robotdiffuse.robots.robot import Robot
from robotdiffuse.server.app import make_app
from robotdiffuse.server.connection import LOG, Connection
from robotdiffuse.server.settings import GRACE_TIME, ServeSettings
from robotdiffuse.server.worker_pool import WorkerPool

KEEP_ALIVE_TIMEOUT = 5
"""Time that a connection stays open after an answer [s]."""
SIGNALS = signal.SIGINT, signal.SIGTERM


class _Server(uvicorn.Server):
    """At the first signal, it refuses waiting requests, lets running ones finish, and stops; at the second
    signal, it stops at once."""

    def __init__(self, config: uvicorn.Config, pool: WorkerPool) -> None:
        super().__init__(config)
        self.pool = pool

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        loop = asyncio.get_running_loop()
        for number in SIGNALS:
            loop.add_signal_handler(number, self._on_signal, number)
        try:
            yield
        finally:
            for number in SIGNALS:
                loop.remove_signal_handler(number)

    def _on_signal(self, number: int) -> None:
        self.pool.stop()
        self.force_exit = self.should_exit
        self.should_exit = True


def serve(robots: dict[str, Robot], settings: ServeSettings, say: Callable[[str], None] = print) -> None:
    """Answer requests until SIGTERM or Ctrl-C. `say` receives a line with the address, and a line when the
    server is ready; standard error gets a line for each request.

    Raises InputError if the address cannot be listened on or no worker can be started.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    LOG.addHandler(handler)
    LOG.setLevel(logging.INFO)
    with listening(settings.host, settings.port) as listener:
        asyncio.run(_serve(robots, settings, listener, say))


async def _serve(
    robots: dict[str, Robot], settings: ServeSettings, listener: socket.socket, say: Callable[[str], None]
) -> None:
    pool = WorkerPool(robots, settings)
    config = uvicorn.Config(
        make_app(pool, robots),
        lifespan="off",
        http=Connection,
        log_level="error",  # `Connection` and `Access` in `app.py` log mistakes of clients
        access_log=False,
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE_TIMEOUT,
        timeout_graceful_shutdown=int(settings.max_time_limit + GRACE_TIME) + 1,
        ws="none",
    )
    server = _Server(config, pool)

    def started(task: asyncio.Future[None]) -> None:
        if task.cancelled() or task.exception() is not None:
            server.should_exit = True
        else:
            remaining = settings.workers - 1
            others = f"; {remaining} more {'is' if remaining == 1 else 'are'} starting" if remaining else ""
            say(f"ready, with 1 worker{others}")

    say(f"listening on {_address(listener)}; loading code (about a minute if it must be compiled)")
    starting = asyncio.ensure_future(pool.start())
    starting.add_done_callback(started)
    try:
        await server.serve([listener])
    finally:
        starting.cancel()
        pool.close()
    if starting.done() and not starting.cancelled():
        starting.result()


def _address(listener: socket.socket) -> str:
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
