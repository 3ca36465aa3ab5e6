"""The HTTP application: endpoints, limits of requests, and errors as one line of JSON; and the server that
runs it."""

import asyncio
import json
import logging
import secrets
import signal
import socket
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, get_type_hints

import uvicorn
from fastapi import FastAPI, Header, Request, Response
from fastapi.openapi.constants import REF_TEMPLATE
from fastapi.responses import JSONResponse, PlainTextResponse
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, ConfigDict, Field, create_model
from pydantic.json_schema import models_json_schema
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from robotdiffuse import __version__
from robotdiffuse.core.errors import described, shown
from robotdiffuse.core.files import JsonObject
from robotdiffuse.core.network import is_loopback, listening, named_host
from robotdiffuse.core.types import SampleRate, Status
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, described_arguments
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.problems.fields import problem_schema
from robotdiffuse.robots.robot import Robot
from robotdiffuse.server.connection import LOG, REFUSED, Connection, log_access
from robotdiffuse.server.settings import GRACE_TIME, ServeSettings
from robotdiffuse.server.worker import PLAN, VERIFY, Answer, failed
from robotdiffuse.server.worker_pool import STOPPING, RequestError, WorkerPool

PROBLEM: JsonObject = {
    "robot": "panda",
    "scene": [{"box": {"center": [0.45, 0.0, 0.3], "size": [0.3, 0.05, 0.6], "name": "wall"}}],
    "start": [0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785],
    "goal": {"joints": [-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785]},
}
WAYPOINTS = [PROBLEM["start"], PROBLEM["goal"]["joints"]]
JOINT_NAMES = [f"panda_joint{i}" for i in range(1, 8)]
VERIFY_EXAMPLE: Any = {"problem": PROBLEM, "path": {"joint_names": JOINT_NAMES, "positions": WAYPOINTS}}

Rows = list[list[float]]
ProblemField = Annotated[JsonObject, Field(description="as in a problem file", examples=[PROBLEM])]


class Error(BaseModel):
    """Any error."""

    error: str = Field(description="one line that says what is wrong")


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid")


_DESCRIPTIONS = described_arguments()
_TYPES = get_type_hints(PlanRequest, include_extras=True)
_ARGUMENTS: dict[str, Any] = {
    field.name: (_TYPES[field.name], Field(field.default, description=_DESCRIPTIONS.get(field.name)))
    for field in fields(PlanRequest)
}
PlanBody = create_model(
    "PlanRequest",
    __base__=_Request,
    __doc__="A problem, and arguments of `rd.plan`.",
    problem=(ProblemField, ...),
    planner=(str, Field(DEFAULT_PLANNER, description="a name of /planners")),
    rate=(
        SampleRate | None,
        Field(
            None,
            description="rows per second of the answer's motion [Hz], which is validated again with these "
            "rows; null: the rows of the plan",
        ),
    ),
    **_ARGUMENTS,
)


class PathMotion(_Request):
    """Waypoints; radians, meters for prismatic joints."""

    joint_names: list[str] = Field(examples=[JOINT_NAMES])
    positions: Rows = Field(examples=[WAYPOINTS])


class TrajectoryMotion(PathMotion):
    """A timed motion; positions, velocities and accelerations have a row for each time [s]."""

    times: list[float]
    velocities: Rows
    accelerations: Rows


class VerifyRequest(_Request):
    """A problem, and a path, a trajectory or both."""

    model_config = ConfigDict(json_schema_extra={"example": VERIFY_EXAMPLE})
    problem: ProblemField
    path: PathMotion | None = None
    trajectory: TrajectoryMotion | None = None


class PlanAnswer(BaseModel):
    """A result, as in a result file of `robotdiffuse plan --out`."""

    model_config = ConfigDict(extra="allow")
    status: Status
    reason: str
    verified: bool
    goal_index: int | None
    joint_names: list[str]
    waypoints: Rows | None
    times: list[float]
    positions: Rows
    velocities: Rows
    accelerations: Rows


class Violation(BaseModel):
    """The first thing that is wrong with a motion. `time` is in seconds or, for a path, the index of a
    waypoint plus the traveled fraction of the segment after it."""

    model_config = ConfigDict(extra="allow")
    kind: str
    message: str
    time: float


class MotionReport(BaseModel):
    """The validator's report on one motion; clearances are lower bounds [m]."""

    valid: bool
    min_clearance: float | None
    scene_clearance: float | None
    self_clearance: float | None
    violation: Violation | None


class VerifyAnswer(BaseModel):
    """The validator's report on each motion of the request."""

    valid: bool
    path: MotionReport | None = None
    trajectory: MotionReport | None = None


class JointInfo(BaseModel):
    """A planned joint: limits in rad, m, rad/s and so on; `lower` and `upper` of a continuous joint are
    null."""

    name: str
    kind: str
    lower: float | None
    upper: float | None
    velocity: float
    acceleration: float


class RobotInfo(BaseModel):
    """A robot that problems may name."""

    name: str
    base: str
    tip: str
    joints: list[JointInfo]
    links: list[str]


class PlannerInfo(BaseModel):
    """A planner that requests may name."""

    name: str
    kind: str
    description: str
    default: bool


class Health(BaseModel):
    """State of the server."""

    status: Literal["starting", "ok", "stopping"]
    workers: int
    workers_ready: int
    workers_busy: int
    requests_waiting: int


class Cancelled(BaseModel):
    """The request that was canceled."""

    cancelled: str = Field(description="its X-Request-ID")


ABOUT = (
    "Motion planning for robot arms; every motion in an answer passed the validator.\n\n"
    "Units: meters, radians, seconds; quaternions wxyz. Problems are those of problem files in JSON. They "
    "name a robot of /robots and contain all other data, because the server reads no files.\n\n"
    'An error is one line of JSON: {"error": "..."}. The header X-Request-ID names a request, so that '
    "DELETE /requests/{name} can cancel it; closing the connection cancels it too."
)
JSON = "application/json"
REQUEST_ID = "X-Request-ID"
MAX_ARRIVING = 64
"""Largest amount of data of incomplete requests, as a multiple of the largest request."""
MAX_REQUEST_ID = 100
"""Longest request ID [characters]."""
ERRORS = {
    400: "the request is wrong",
    401: "the token is missing or wrong",
    404: "no such request is running",
    408: "the request did not arrive in time",
    409: "the request was canceled, or its X-Request-ID is in use",
    413: "the request is too large, or needs more memory than a worker may use",
    415: "wrong Content-Type",
    421: "wrong Host",
    429: "the queue is full, and Retry-After says when to try again; or too much data is arriving",
    500: "the worker failed on this request",
    503: "the server is stopping, or the request took too long",
}
REQUEST_ERRORS = (400, 401, 408, 409, 413, 415, 421, 429, 500, 503)
RequestID = Annotated[str, Header(alias=REQUEST_ID, description="names the request, to cancel it")]


@dataclass(eq=False)
class Access:
    """Middleware: checks the bearer token and, on loopback, that the Host header names this machine; logs a
    line for each request.

    The Host check stops DNS rebinding, in which a page of another site reaches this server by a name of its
    own that resolves to 127.0.0.1.
    """

    app: ASGIApp
    settings: ServeSettings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        began = time.monotonic()
        code = CLIENT_GONE
        request = Request(scope)
        # If a client asks for it, the server closes the connection after the answer. A client that is still
        # sending would then lose the answer, so the rest of its request is read first.
        unread = request.headers.get("connection", "").lower() == "close"

        async def receiving() -> Message:
            nonlocal unread
            message = await receive()
            unread = unread and message.get("more_body", False)
            return message

        async def sending(message: Message) -> None:
            nonlocal code
            if message["type"] == "http.response.start":
                code = message["status"]
                while unread and code >= 400:
                    await receiving()
            await send(message)

        try:
            await (self._refusal(request) or self.app)(scope, receiving, sending)
        except asyncio.CancelledError:  # a second signal, or the end of `timeout_graceful_shutdown`
            if code == CLIENT_GONE:  # no answer has begun
                await _error(503, STOPPING)(scope, receive, sending)
        except Exception:
            code = 500  # the handler in `make_app` answers outside of this middleware
            raise
        finally:
            name = request.headers.get(REQUEST_ID, "")
            target = f"{scope['method']} {scope['raw_path'].decode('latin-1')}"
            code = scope.get("state", {}).get(REFUSED, code)
            log_access(scope["client"], target, code, time.monotonic() - began, name)

    def _refusal(self, request: Request) -> Response | None:
        host = request.headers.get("host", "")
        if is_loopback(self.settings.host) and not is_loopback(named_host(host)):
            return _error(421, f"the host is {shown(host)}; this server is known as localhost")
        authorization = request.headers.get("authorization", "")
        token = self.settings.token
        # header values are decoded as Latin-1, and most clients send UTF-8
        sent = (authorization.encode(), authorization.encode("latin-1", "replace"))
        right = f"Bearer {token}".encode()
        if token and not any(secrets.compare_digest(value, right) for value in sent):
            text = "the header Authorization must be: Bearer TOKEN"
            return _error(401, text, {"WWW-Authenticate": "Bearer"})
        return None


def make_app(pool: WorkerPool, robots: dict[str, Robot]) -> FastAPI:
    """The application; the caller starts the pool."""
    app = FastAPI(
        title="RobotDiffuse",
        version=__version__,
        description=ABOUT,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.add_middleware(Access, settings=pool.settings)
    app.exception_handler(RequestError)(lambda _, error: _error(error.code, str(error), error.headers))
    app.exception_handler(HTTPException)(_http_error)
    app.exception_handler(Exception)(lambda _, error: _error(500, described(error)))
    _add_requests(app, pool, pool.settings)
    _add_lists(app, pool, robots)
    _describe_bodies(app)
    return app


def _describe_bodies(app: FastAPI) -> None:
    """Complete the OpenAPI description: add the models of bodies that endpoints read themselves, and remove
    the answer 422 of FastAPI's own validation, which no endpoint uses."""
    _, models = models_json_schema(
        [(PlanBody, "validation"), (VerifyRequest, "validation")], ref_template=REF_TEMPLATE
    )
    description = app.openapi()
    schemas = description["components"]["schemas"]
    schemas |= models["$defs"]
    problem = json.loads(json.dumps(problem_schema()).replace("#/$defs/", REF_TEMPLATE.format(model="")))
    schemas |= problem.pop("$defs") | {"Problem": problem}
    for body in (PlanBody, VerifyRequest):
        schemas[body.__name__]["properties"]["problem"]["$ref"] = REF_TEMPLATE.format(model="Problem")
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    for methods in description["paths"].values():
        for operation in methods.values():
            operation["responses"].pop("422", None)


def _errors(*codes: int) -> dict[int | str, JsonObject]:
    return {code: {"model": Error, "description": ERRORS[code]} for code in codes}


def _body(model: type[BaseModel] | None, description: str) -> JsonObject:
    """The OpenAPI description of a request whose body the endpoint reads itself. `model` is the type of the
    body; None: JSON lines, each a PlanBody."""
    schema = {"type": "string"} if model is None else {"$ref": REF_TEMPLATE.format(model=model.__name__)}
    content = {LINES if model is None else JSON: {"schema": schema}}
    return {"requestBody": {"required": True, "description": description, "content": content}}


def _add_requests(app: FastAPI, pool: WorkerPool, settings: ServeSettings) -> None:
    running = dict[str, Callable[[], None]]()

    async def single(request: Request, endpoint: str, name: str) -> Response:
        body = await read_body(request, pool, JSON)
        with pool.admit(1):
            task = asyncio.ensure_future(pool.run(endpoint, body))
            with _cancellable(request, name, running, [task]) as disconnected:
                answer = await answer_of(task, disconnected)
                return Response(answer.body, answer.code, media_type=JSON)

    @app.post(
        "/plan",
        summary="Plan a motion",
        response_model=PlanAnswer,
        responses=_errors(*REQUEST_ERRORS),
        openapi_extra=_body(PlanBody, "a problem, and arguments of plan"),
    )
    async def plan(request: Request, name: RequestID = "") -> Response:
        """The answer has code 200 for every status of the result, even if no motion was found."""
        return await single(request, PLAN, name)

    @app.post(
        "/verify",
        summary="Validate a path or a trajectory",
        response_model=VerifyAnswer,
        responses=_errors(*REQUEST_ERRORS),
        openapi_extra=_body(VerifyRequest, "a problem, and a path, a trajectory or both"),
    )
    async def verify(request: Request, name: RequestID = "") -> Response:
        """The motion may come from any planner."""
        return await single(request, VERIFY, name)

    @app.post(
        "/batch",
        summary="Plan many motions",
        response_description="a result or an error in each line",
        responses=_errors(*REQUEST_ERRORS) | {200: {"content": {LINES: {"schema": {"type": "string"}}}}},
        openapi_extra=_body(None, "a request of /plan in each line"),
        response_class=Response,
    )
    async def batch(request: Request, name: RequestID = "") -> Response:
        """Each line of the answer is the answer of /plan to one line of the request, in the same order; a
        line is sent as soon as it and all lines before it are done. Blank lines are ignored."""

        async def write(send: Send) -> None:
            body = await read_body(request, pool, LINES)
            lines = [line for line in body.split(b"\n") if line.strip()]
            if not 1 <= len(lines) <= settings.max_batch:
                raise RequestError(
                    400, f"the batch has {len(lines)} lines; it must have 1 to {settings.max_batch}"
                )
            at_once = min(len(lines), settings.workers)
            with pool.admit(at_once):
                tasks = plan_tasks(pool, lines, at_once)
                with _cancellable(request, name, running, tasks) as disconnected:
                    await send_lines(send, tasks, disconnected)

        return StreamedResponse(write)

    @app.delete(
        "/requests/{name:path}",
        summary="Cancel a running request",
        response_model=Cancelled,
        responses=_errors(401, 404, 421),
    )
    async def cancel(name: str) -> Response:
        """Cancels the request that was sent with this name in its header X-Request-ID."""
        # header values are decoded as Latin-1, and most clients send UTF-8
        in_header = name.encode("utf-8", "replace").decode("latin-1")
        cancel_request = running.get(name) or running.get(in_header)
        if cancel_request is None:
            raise RequestError(404, f"no request {shown(name)} is running")
        cancel_request()
        return JSONResponse({"cancelled": name})


def _add_lists(app: FastAPI, pool: WorkerPool, robots: dict[str, Robot]) -> None:
    entries = [robot_info(name, robot) for name, robot in robots.items()]
    errors = _errors(401, 421)

    @app.get("/robots", summary="List the robots that problems may name", responses=errors)
    async def list_robots() -> list[RobotInfo]:
        return entries

    @app.get("/planners", summary="List the planners that requests may name", responses=errors)
    async def list_planners() -> list[PlannerInfo]:
        return [
            PlannerInfo(
                name=name, kind=entry.kind, description=entry.description, default=name == DEFAULT_PLANNER
            )
            for name, entry in PLANNERS.load_installed().items()
        ]

    @app.get(
        "/health",
        summary="Whether the server accepts requests",
        response_model=Health,
        responses=errors
        | {503: {"model": Health, "description": "no worker is ready, or the server is stopping"}},
    )
    async def health() -> Response:
        status = "stopping" if pool.stopping else "ok" if pool.ready else "starting"
        return JSONResponse({"status": status} | pool.state(), 200 if status == "ok" else 503)

    @app.get("/metrics", summary="Metrics for Prometheus", responses=errors, response_class=PlainTextResponse)
    async def metrics() -> Response:
        return Response(pool.metrics.text(), media_type=CONTENT_TYPE_LATEST)

    @app.get("/", include_in_schema=False)
    async def plain() -> Response:
        return PlainTextResponse(endpoint_list(app))


def endpoint_list(app: FastAPI) -> str:
    """A plain list of all endpoints, from the OpenAPI description."""
    description = app.openapi()
    lines = [
        f"{method.upper():7}{path:18}{operation['summary']}"
        for path, methods in description["paths"].items()
        for method, operation in methods.items()
    ]
    info = description["info"]
    fields = "Fields, limits and errors: /openapi.json"
    return "\n".join([f"{info['title']} {info['version']}", info["description"], "", *lines, "", fields, ""])


@contextmanager
def _cancellable(
    request: Request, name: str, running: dict[str, Callable[[], None]], tasks: list[asyncio.Task[Answer]]
) -> Iterator[asyncio.Future[None]]:
    """Within the block, the tasks of a request can be canceled by the request's name. Tasks that the block
    leaves unfinished are canceled. Yields a future that is done once the client has closed the connection.
    Raises RequestError for a name that is too long or in use."""
    disconnected = asyncio.ensure_future(wait_for_disconnect(request))

    def cancel() -> None:
        for task in tasks:
            task.cancel()

    try:
        if len(name) > MAX_REQUEST_ID:
            raise RequestError(400, f"{REQUEST_ID} has {len(name)} characters; it may have {MAX_REQUEST_ID}")
        if name in running:
            raise RequestError(409, f"another request {shown(name)} is running")
        if name:
            running[name] = cancel
        yield disconnected
    finally:
        disconnected.cancel()
        if running.get(name) is cancel:
            del running[name]
        cancel()


async def read_body(request: Request, pool: WorkerPool, kind: str) -> bytes:
    """The body of a request. Raises RequestError if the body is too large or not of Content-Type `kind`, if
    the server is receiving too much data of all requests together, or if the client disconnects. `Connection`
    ends requests that arrive slowly."""
    max_size = pool.settings.max_request_size
    content_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if content_type != kind:
        raise RequestError(415, f"Content-Type is {shown(content_type)}; it must be {kind}")
    # the connection stays open: many clients lose an answer if it is closed while they are sending
    too_large = RequestError(413, f"the request is too large: it may have at most {max_size} bytes")
    length = request.headers.get("content-length", "0")
    if not length.isdecimal() or int(length) > max_size:
        raise too_large
    body = bytearray()
    try:
        async for part in request.stream():
            body += part
            pool.arriving_bytes += len(part)
            if len(body) > max_size:
                raise too_large
            if pool.arriving_bytes > MAX_ARRIVING * max_size:
                limit_text = f"{MAX_ARRIVING * max_size} bytes"
                raise RequestError(429, f"unfinished requests hold more than {limit_text}; try again later")
    except ClientDisconnect:
        raise RequestError(CLIENT_GONE, "the client closed the connection") from None
    finally:
        pool.arriving_bytes -= len(body)
    return bytes(body)


def robot_info(name: str, robot: Robot) -> RobotInfo:
    """The entry of a robot in /robots."""
    joints = [
        JointInfo(
            name=joint.name,
            kind=joint.kind,
            lower=None if joint.kind == "continuous" else joint.lower,
            upper=None if joint.kind == "continuous" else joint.upper,
            velocity=joint.velocity,
            acceleration=joint.acceleration,
        )
        for joint in robot.planned_joints
    ]
    return RobotInfo(name=name, base=robot.base, tip=robot.tip, joints=joints, links=list(robot.link_names))


def _error(code: int, message: str, headers: Mapping[str, str] | None = None) -> Response:
    answer = failed(code, message)
    return Response(answer.body, code, headers and {**headers}, JSON)


def _http_error(request: Request, error: Any) -> Response:
    path = shown(request.url.path)
    message = f"there is no {path}; see /docs"
    if error.status_code == 405:
        message = f"{path} does not take {request.method}; it takes {(error.headers or {}).get('Allow')}"
    return _error(error.status_code, message, error.headers)


LINES = "application/x-ndjson"
CLIENT_GONE = 499
"""Status code, for the log only, of a request whose client closed the connection."""


async def wait_for_disconnect(request: Request) -> None:
    """Returns when the client has closed the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


async def answer_of(task: asyncio.Task[Answer], disconnected: asyncio.Future[None]) -> Answer:
    """The answer of the task, or an error if it is canceled or the client disconnects first."""
    await asyncio.wait({task, disconnected}, return_when=asyncio.FIRST_COMPLETED)
    if not task.done():
        return failed(CLIENT_GONE, "the client closed the connection")
    return failed(409, "the request was canceled") if task.cancelled() else task.result()


def plan_tasks(pool: WorkerPool, lines: list[bytes], at_once: int) -> list[asyncio.Task[Answer]]:
    """A task for each line; at most `at_once` of them are in the pool at a time."""
    limit = asyncio.Semaphore(at_once)

    async def answer_line(line: bytes) -> Answer:
        async with limit:
            return await pool.run(PLAN, line)

    return [asyncio.ensure_future(answer_line(line)) for line in lines]


async def send_lines(
    send: Send, tasks: list[asyncio.Task[Answer]], disconnected: asyncio.Future[None]
) -> None:
    """Send the answers in the order of the tasks."""
    headers = [(b"content-type", LINES.encode())]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    for task in tasks:
        answer = await answer_of(task, disconnected)
        if disconnected.done():
            return
        await send({"type": "http.response.body", "body": answer.body, "more_body": True})
    await send({"type": "http.response.body", "body": b""})


class StreamedResponse(Response):
    """A response that `write` sends piece by piece; errors before the first piece still get a status code."""

    def __init__(self, write: Callable[[Send], Awaitable[None]]) -> None:
        self.write = write
        self.background = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self.write(send)


KEEP_ALIVE_TIMEOUT = 5
"""Time that a connection stays open after an answer [s]."""
SIGNALS = signal.SIGINT, signal.SIGTERM


class _Server(uvicorn.Server):
    """At the first signal, it refuses waiting requests, lets running ones finish within
    `timeout_graceful_shutdown`, and stops; at the second signal, it stops at once."""

    def __init__(self, config: uvicorn.Config, pool: WorkerPool) -> None:
        super().__init__(config)
        self.pool = pool

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        loop = asyncio.get_running_loop()
        for number in SIGNALS:
            loop.add_signal_handler(number, self._on_signal)
        try:
            yield
        finally:
            for number in SIGNALS:
                loop.remove_signal_handler(number)

    def _on_signal(self) -> None:
        self.pool.stop()
        self.force_exit = self.should_exit
        self.should_exit = True


def serve(robots: dict[str, Robot], settings: ServeSettings, say: Callable[[str], None] = print) -> None:
    """Answer requests until SIGTERM or Ctrl-C. `say` receives a line with the address, and a line when the
    server is ready; standard error gets a line for each request.

    Raises InputError if the address cannot be listened on, for more than MAX_WORKERS workers, and if the
    first worker cannot be started.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    LOG.addHandler(handler)
    LOG.setLevel(logging.INFO)
    try:
        with listening(settings.host, settings.port) as listener:
            asyncio.run(_serve(robots, settings, listener, say))
    finally:
        LOG.removeHandler(handler)


async def _serve(
    robots: dict[str, Robot], settings: ServeSettings, listener: socket.socket, say: Callable[[str], None]
) -> None:
    pool = WorkerPool(robots, settings)
    config = uvicorn.Config(
        make_app(pool, robots),
        lifespan="off",
        http=Connection,
        log_level="error",  # `Connection` and `Access` log mistakes of clients
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
            starting_note = (
                f"; {remaining} more {'is' if remaining == 1 else 'are'} starting" if remaining else ""
            )
            say(f"ready, with 1 worker{starting_note}")

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
