"""What a server answers: the paths, their bounds and their errors, each of one line."""

import asyncio
import secrets
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from ipaddress import ip_address
from math import ceil
from typing import Any
from urllib.parse import urlsplit

from fastapi import FastAPI, Request, Response
from fastapi.responses import HTMLResponse, JSONResponse, PlainTextResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send

from robotdiffuse import __version__
from robotdiffuse.core.errors import shown
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS
from robotdiffuse.robots.robot import Robot
from robotdiffuse.server import openapi
from robotdiffuse.server.settings import SENDING, ServeSettings
from robotdiffuse.server.worker import PLAN, VERIFY, Answer, failed
from robotdiffuse.server.worker_pool import Pool, QueueFullError

JSON, LINES = "application/json", "application/x-ndjson"
REQUEST_ID = "X-Request-ID"
LONGEST_ID = 100
GONE = 499
"""The client has gone, and nobody reads the answer; the code is for the metrics."""


class RequestError(Exception):
    """A request that is answered without a worker."""

    def __init__(self, code: int, message: str, **headers: str) -> None:
        super().__init__(message)
        self.code, self.headers = code, headers


class Door:
    """What every request passes: the token, and that a browser was not led here by another page's address."""

    def __init__(self, app: ASGIApp, settings: ServeSettings) -> None:
        self.app, self.settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        refused = self._refused(Request(scope)) if scope["type"] == "http" else None
        await (refused or self.app)(scope, receive, send)

    def _refused(self, request: Request) -> Response | None:
        host = request.headers.get("host", "")
        if self.settings.on_loopback and not _local(host):
            return _error(421, f"the host is {shown(host)}; this server is known as localhost")
        given, token = request.headers.get("authorization", ""), self.settings.token
        if token and not secrets.compare_digest(given.encode(), f"Bearer {token}".encode()):
            return _error(
                401, "the header Authorization must be: Bearer TOKEN", **{"WWW-Authenticate": "Bearer"}
            )
        return None


def _local(host: str) -> bool:
    """Of what a header says, with or without a port."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ip_address(name).is_loopback
    except ValueError:
        return False


def make_app(pool: Pool, robots: dict[str, Robot]) -> FastAPI:
    """The application; the pool is started by others."""
    app = FastAPI(
        title="RobotDiffuse",
        version=__version__,
        description=openapi.ABOUT,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.add_middleware(Door, settings=pool.settings)
    app.exception_handler(RequestError)(_refused)
    app.exception_handler(QueueFullError)(_full)
    app.exception_handler(HTTPException)(_http_error)
    app.exception_handler(Exception)(_unexpected)
    _add_requests(app, pool, pool.settings)
    _add_lists(app, pool, robots)
    return app


def _add_requests(app: FastAPI, pool: Pool, settings: ServeSettings) -> None:
    running: dict[str, Callable[[], None]] = {}

    async def single(request: Request, what: str) -> Response:
        with pool.places(1):
            body = await _body(request, settings.largest, JSON)
            task = asyncio.ensure_future(pool.run(what, body))
            with _under_way(request, running, [task]):
                answer = await _answered(task, asyncio.ensure_future(_gone(request)))
                return Response(answer.body, answer.code, media_type=JSON)

    @app.post("/plan", **openapi.PLAN)
    async def plan(request: Request) -> Response:
        """Plan a motion. Every status of a result has code 200: that there is no plan is an answer."""
        return await single(request, PLAN)

    @app.post("/verify", **openapi.VERIFY)
    async def verify(request: Request) -> Response:
        """Validate a path or a trajectory, whoever made it."""
        return await single(request, VERIFY)

    @app.post("/batch", **openapi.BATCH)
    async def batch(request: Request) -> Response:
        """Plan many: a request of /plan in each line, and in each line of the answer what /plan answers, in
        the same order, as soon as those before it are there."""

        async def write(send: Send) -> None:
            with pool.places(1):
                body = await _body(request, settings.largest, LINES)
                lines = [line for line in body.split(b"\n") if line.strip()]
                if not 1 <= len(lines) <= settings.batch:
                    raise RequestError(
                        400, f"the batch has {len(lines)} lines; it must have 1 to {settings.batch}"
                    )
                at_once = min(len(lines), settings.workers)
                with pool.places(at_once - 1):
                    tasks = _tasks(pool, lines, at_once)
                    with _under_way(request, running, tasks):
                        await _write(send, tasks, asyncio.ensure_future(_gone(request)))

        return _Written(write)

    @app.delete("/requests/{name}", **openapi.DELETE)
    async def cancel(name: str) -> Response:
        """End the request that came with this name in its header X-Request-ID."""
        if name not in running:
            raise RequestError(404, f"no request {shown(name)} is under way")
        running[name]()
        return JSONResponse({"cancelled": name})


def _add_lists(app: FastAPI, pool: Pool, robots: dict[str, Robot]) -> None:
    known = [_about(name, robot) for name, robot in robots.items()]

    @app.get("/robots", **openapi.ROBOTS)
    async def list_robots() -> Response:
        """The robots that problems may name."""
        return JSONResponse(known)

    @app.get("/planners", **openapi.PLANNERS)
    async def list_planners() -> Response:
        """The planners that requests may name."""
        return JSONResponse(
            [
                {
                    "name": name,
                    "kind": of.kind,
                    "description": of.description,
                    "default": name == DEFAULT_PLANNER,
                }
                for name, of in PLANNERS.items()
            ]
        )

    @app.get("/health", **openapi.HEALTH)
    async def health() -> Response:
        """Whether requests are taken: 503 while no worker is ready, and when the server stops."""
        status = "stopping" if pool.stopping else "ok" if pool.ready else "starting"
        state = {name: value for name, (_, value) in pool.gauges().items()}
        return JSONResponse({"status": status} | state, 200 if status == "ok" else 503)

    @app.get("/metrics", **openapi.METRICS)
    async def metrics() -> Response:
        """Counts for Prometheus."""
        text = pool.metrics.text(pool.gauges())
        return PlainTextResponse(text, media_type="text/plain; version=0.0.4")

    @app.get("/", include_in_schema=False)
    @app.get("/docs", include_in_schema=False)
    async def docs() -> Response:
        return HTMLResponse(openapi.html(app.openapi()))


@contextmanager
def _under_way(
    request: Request, running: dict[str, Callable[[], None]], tasks: list[asyncio.Task[Answer]]
) -> Iterator[None]:
    """While this lasts, the tasks of a request can be cancelled by its name; they end with it."""
    name = request.headers.get(REQUEST_ID, "")

    def cancel() -> None:
        for task in tasks:
            task.cancel()

    try:
        if len(name) > LONGEST_ID:
            raise RequestError(400, f"{REQUEST_ID} has {len(name)} characters; it may have {LONGEST_ID}")
        if name in running:
            raise RequestError(409, f"another request {shown(name)} is under way")
        if name:
            running[name] = cancel
        yield
    finally:
        if running.get(name) is cancel:
            del running[name]
        cancel()


async def _gone(request: Request) -> None:
    """Until the client has gone."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


async def _answered(task: asyncio.Task[Answer], gone: asyncio.Future[None]) -> Answer:
    """What the task ends with, if nobody cancels it and the client stays."""
    try:
        await asyncio.wait({task, gone}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        gone.cancel()
    if not task.done():
        return failed(GONE, "the client has gone")
    return failed(409, "the request was cancelled") if task.cancelled() else task.result()


def _tasks(pool: Pool, lines: list[bytes], at_once: int) -> list[asyncio.Task[Answer]]:
    """Of which so many are with workers or wait for them at once."""
    limit = asyncio.Semaphore(at_once)

    async def one(line: bytes) -> Answer:
        async with limit:
            return await pool.run(PLAN, line)

    return [asyncio.ensure_future(one(line)) for line in lines]


async def _write(send: Send, tasks: list[asyncio.Task[Answer]], gone: asyncio.Future[None]) -> None:
    """The answers in the order of the tasks."""
    try:
        kind = [(b"content-type", LINES.encode())]
        await send({"type": "http.response.start", "status": 200, "headers": kind})
        for task in tasks:
            await asyncio.wait({task, gone}, return_when=asyncio.FIRST_COMPLETED)
            if gone.done():
                return
            answer = failed(409, "the request was cancelled") if task.cancelled() else task.result()
            await send({"type": "http.response.body", "body": answer.body, "more_body": True})
        await send({"type": "http.response.body", "body": b""})
    finally:
        gone.cancel()


class _Written(Response):
    """A response that is written bit by bit."""

    def __init__(self, write: Callable[[Send], Awaitable[None]]) -> None:
        self.write, self.background = write, None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self.write(send)


async def _body(request: Request, largest: int, kind: str) -> bytes:
    """The bytes of a request, within bounds of size and time, and of the right kind."""
    given = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if given != kind:
        raise RequestError(415, f"Content-Type is {shown(given)}; it must be {kind}")
    too_large = RequestError(
        413, f"the request is too large: it may have {largest} bytes", Connection="close"
    )
    length = request.headers.get("content-length", "0")
    if not length.isdecimal() or int(length) > largest:
        raise too_large
    parts: list[bytes] = []
    try:
        async with asyncio.timeout(SENDING):
            async for part in request.stream():
                parts.append(part)
                if sum(map(len, parts)) > largest:
                    raise too_large
    except TimeoutError:
        raise RequestError(
            408, f"the request took more than {SENDING:g} s to arrive", Connection="close"
        ) from None
    except ClientDisconnect:
        raise RequestError(GONE, "the client has gone") from None
    return b"".join(parts)


def _about(name: str, robot: Robot) -> dict[str, Any]:
    """For the list of robots."""
    joints = [
        {
            "name": joint.name,
            "kind": joint.kind,
            "lower": None if joint.kind == "continuous" else joint.lower,
            "upper": None if joint.kind == "continuous" else joint.upper,
            "velocity": joint.velocity,
            "acceleration": joint.acceleration,
        }
        for joint in robot.planned_joints
    ]
    links = list(robot.link_names)
    return {"name": name, "base": robot.base, "tip": robot.tip, "joints": joints, "links": links}


def _error(code: int, message: str, **headers: str) -> Response:
    answer = failed(code, message)
    return Response(answer.body, code, headers, JSON)


def _refused(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestError)
    return _error(error.code, str(error), **error.headers)


def _unexpected(_: Request, error: Exception) -> Response:
    return _error(500, f"{type(error).__name__}: {error}")


def _full(_: Request, error: Exception) -> Response:
    assert isinstance(error, QueueFullError)
    seconds = ceil(error.seconds)
    return _error(429, f"the queue is full; come again in {seconds} s", **{"Retry-After": str(seconds)})


def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    if error.status_code == 404:
        return _error(404, f"there is no {shown(request.url.path)}; /docs says what there is")
    return _error(error.status_code, str(error.detail), **(error.headers or {}))
