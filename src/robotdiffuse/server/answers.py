"""Answers of requests that run in the pool: waiting for them, and sending them as they come."""

import asyncio
from collections.abc import Awaitable, Callable

from fastapi import Request, Response
from starlette.types import Receive, Scope, Send

from robotdiffuse.server.worker import PLAN, Answer, failed
from robotdiffuse.server.worker_pool import WorkerPool

LINES = "application/x-ndjson"
CLIENT_GONE = 499
"""Status code of a request whose client closed the connection; nobody reads it."""


async def wait_for_disconnect(request: Request) -> None:
    """Returns when the client has closed the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


async def answer_of(task: asyncio.Task[Answer], disconnected: asyncio.Future[None]) -> Answer:
    """The answer of the task, or an error if it is cancelled or the client disconnects first."""
    try:
        await asyncio.wait({task, disconnected}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        disconnected.cancel()
    if not task.done():
        return failed(CLIENT_GONE, "the client closed the connection")
    return failed(409, "the request was cancelled") if task.cancelled() else task.result()


def plan_tasks(pool: WorkerPool, lines: list[bytes], at_once: int) -> list[asyncio.Task[Answer]]:
    """A task for each line; at most `at_once` of them are in the pool at a time."""
    limit = asyncio.Semaphore(at_once)

    async def one(line: bytes) -> Answer:
        async with limit:
            return await pool.run(PLAN, line)

    return [asyncio.ensure_future(one(line)) for line in lines]


async def send_lines(
    send: Send, tasks: list[asyncio.Task[Answer]], disconnected: asyncio.Future[None]
) -> None:
    """Send the answers in the order of the tasks."""
    try:
        headers = [(b"content-type", LINES.encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        for task in tasks:
            await asyncio.wait({task, disconnected}, return_when=asyncio.FIRST_COMPLETED)
            if disconnected.done():
                return
            answer = failed(409, "the request was cancelled") if task.cancelled() else task.result()
            await send({"type": "http.response.body", "body": answer.body, "more_body": True})
        await send({"type": "http.response.body", "body": b""})
    finally:
        disconnected.cancel()


class StreamedResponse(Response):
    """A response that `write` sends piece by piece; errors before the first piece still get a status code."""

    def __init__(self, write: Callable[[Send], Awaitable[None]]) -> None:
        self.write = write
        self.background = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self.write(send)
