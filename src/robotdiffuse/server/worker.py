"""Worker process of a server: turns the body of a request into the body of its answer."""

import json
import os
import signal
import sys
import time
import traceback
from ctypes import Structure, c_double, c_int64
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import orjson

from robotdiffuse.core.deadline import cancel_check, check_cancelled
from robotdiffuse.core.errors import InputError, shortened, shown
from robotdiffuse.core.input_files import parse_json
from robotdiffuse.core.loading import compile_seconds
from robotdiffuse.core.results import PlanResult
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, load_planner
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.files import problem_from_record
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.files import check_fields
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box
from robotdiffuse.server.motions import MOTIONS, read_motion, report_record
from robotdiffuse.server.settings import GRACE_TIME
from robotdiffuse.validation.report import Report
from robotdiffuse.validation.validator import Verifier

PLAN, VERIFY = "plan", "verify"
MAX_SEED = 2**32 - 1
"""Largest seed that all random generators accept."""


class Answer(NamedTuple):
    """The answer of a worker."""

    code: int
    """HTTP status code."""
    body: bytes
    status: str
    """Status of the result; for verify, valid or invalid; "" for an error."""
    memory: int = 0
    """Memory of the worker process [bytes]."""


class Shared(Structure):
    """Memory that a worker shares with the server."""

    _fields_ = [("cancelled", c_int64), ("due", c_double)]
    cancelled: int
    """Number of the call to cancel."""
    due: float
    """Monotonic time by which the running call will have ended [s]; 0 while code is compiled for it."""


class Cancelled(BaseException):
    """The call was cancelled."""


@dataclass
class _State:
    """State of a worker process between requests."""

    robots: dict[str, Robot]
    """Robots that requests may name."""
    max_time_limit: float
    """Largest time limit of a request [s]."""
    shared: Shared


_state: _State | None = None
_warm: set[tuple[str, str]] = set()


def prepare(robots: dict[str, Robot], max_time_limit: float, shared: Shared) -> None:
    """Set up a new worker process."""
    accept(robots, max_time_limit, shared)
    signal.signal(
        signal.SIGTERM, signal.SIG_IGN
    )  # service managers signal all processes; the server ends its workers itself


def accept(robots: dict[str, Robot], max_time_limit: float, shared: Shared) -> None:
    """Accept requests from now on; see `_State`."""
    global _state
    _state = _State(robots, max_time_limit, shared)


def warm_up() -> bool:
    """Load or compile the code that most requests need; returns whether anything was compiled."""
    assert _state is not None
    name, robot = next(iter(_state.robots.items()))
    start = (robot.lower + robot.upper) / 2
    start[1:2] += 0.3  # an arm that points up does not move its tip by its first joint
    goal = start.copy()
    goal[0] += (robot.upper[0] - start[0]) / 2
    far = Scene([Box([2.0, 2.0, 2.0], [0.1, 0.1, 0.1])])
    _warm_up_once(_planner(DEFAULT_PLANNER), Problem(robot, far, start, goal), name)
    return compile_seconds() > 0


def respond(number: int, endpoint: str, body: bytes) -> Answer:
    """The answer to a request. Raises Cancelled if the server cancels the call by its number."""
    state = _state
    assert state is not None

    def raise_if_cancelled() -> None:
        if state.shared.cancelled == number:
            raise Cancelled

    try:
        with cancel_check(raise_if_cancelled):
            raise_if_cancelled()  # it may have been cancelled before it began
            answer = (answer_plan if endpoint == PLAN else answer_verify)(state, body)
        return answer._replace(memory=_memory())
    except InputError as error:
        return failed(400, str(error))
    except Cancelled:
        raise
    except BaseException as error:  # a SystemExit of a planner would end the server's event loop
        traceback.print_exc(file=sys.stderr)
        return failed(500, f"{type(error).__name__}: {shortened(str(error))}")


def _memory() -> int:
    """Memory of this process [bytes]; 0 if the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def failed(code: int, message: str) -> Answer:
    """An error as one line of JSON."""
    line = " ".join(message.split())
    return Answer(code, json.dumps({"error": line}).encode() + b"\n", "")


def _record(body: bytes) -> object:
    """The JSON value of a body."""
    try:
        text = body.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"the request is not UTF-8 text: byte {error.start}") from None
    return parse_json(text, "the request")


def answer_plan(state: _State, body: bytes) -> Answer:
    """The answer to a request to plan. Raises InputError for a bad request."""
    requested = check_fields("the request", _record(body), ("problem",), ARGUMENTS)
    problem = problem_from_record(requested["problem"], state.robots)
    given = {name: value for name, value in requested.items() if name not in ("problem", "planner")}
    request = PlanRequest(**given)
    if request.time_limit > state.max_time_limit:
        most = f"it must be at most {state.max_time_limit:g} s here"
        raise InputError(f"time_limit is {shown(request.time_limit)}; {most}")
    if request.seed > MAX_SEED:
        raise InputError(f"seed is {shown(request.seed)}; it must be at most {MAX_SEED}")
    planner = _planner(requested.get("planner", DEFAULT_PLANNER))
    planner.prepare(problem.robot)
    _warm_up_once(planner, problem, requested["problem"]["robot"])
    state.shared.due = time.monotonic() + request.time_limit + GRACE_TIME
    result: PlanResult = planner.plan(problem, **given)
    return _answer(result.record(), result.status.value)


ARGUMENTS = ("planner", *(field.name for field in fields(PlanRequest)))
"""Fields of a plan request besides its problem."""


def _planner(name: object) -> Planner:
    """The planner of a name, loaded once. Raises InputError for an unknown name."""
    PLANNERS.entry(name)
    return _loaded(str(name))


@lru_cache(maxsize=64)
def _loaded(name: str) -> Planner:
    return load_planner(name)


def _warm_up_once(planner: Planner, problem: Problem, robot: str) -> None:
    """Compile or load code before the time limit starts, once for each planner and robot."""
    if (planner.name, robot) not in _warm:
        planner.warm_up(problem)
        _warm.add((planner.name, robot))


def answer_verify(state: _State, body: bytes) -> Answer:
    """The answer to a request to validate. Raises InputError for a bad request."""
    values = check_fields("the request", _record(body), ("problem",), MOTIONS)
    problem = problem_from_record(values["problem"], state.robots)
    motions = {name: read_motion(name, values[name]) for name in MOTIONS if name in values}
    if not motions:
        raise InputError("the request has neither path nor trajectory")
    state.shared.due = time.monotonic() + state.max_time_limit + GRACE_TIME
    validator = Verifier(problem)
    reports: dict[str, Report] = {}
    for name, motion in motions.items():
        check_cancelled()
        reports[name] = getattr(validator, name)(motion)
    valid = all(report.valid for report in reports.values())
    record = {"valid": valid} | {name: report_record(report) for name, report in reports.items()}
    return _answer(record, "valid" if valid else "invalid")


def _answer(record: dict[str, Any], status: str) -> Answer:
    return Answer(200, orjson.dumps(record, option=orjson.OPT_APPEND_NEWLINE), status)
