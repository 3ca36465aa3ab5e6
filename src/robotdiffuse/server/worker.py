"""What the worker processes of a server do: bytes of a request in, bytes of an answer out."""

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

from robotdiffuse.collision.kernels.compiled import compile_seconds
from robotdiffuse.core.deadline import check_left, left_by
from robotdiffuse.core.errors import InputError, shortened, shown, unknown_name
from robotdiffuse.core.input_files import parse_json
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import UNTIL
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
from robotdiffuse.server.settings import GRACE
from robotdiffuse.validation.validator import Report, Verifier

PLAN, VERIFY = "plan", "verify"
SEED, TIME_LIMIT = 0, 1.0
LARGEST_SEED = 2**32 - 1
"""That all random generators take."""


class Answer(NamedTuple):
    """Of a worker."""

    code: int
    """As of HTTP."""
    body: bytes
    status: str
    """Of the result; valid or invalid; "" for an error."""
    memory: int = 0
    """What the worker's process holds [bytes]."""


class Shared(Structure):
    """Memory of a worker and the server."""

    _fields_ = [("cancelled", c_int64), ("due", c_double)]
    cancelled: int
    """The number of the call that is to be left."""
    due: float
    """When the call under way will have ended, of the monotonic clock [s]; 0 while its code is compiled."""


class Cancelled(BaseException):
    """Nobody waits for the answer any more."""


@dataclass
class _State:
    """What a process keeps between requests."""

    robots: dict[str, Robot]
    """Those that requests may name."""
    longest: float
    """Time limit of a request at most [s]."""
    shared: Shared


_state: _State | None = None
_warm: set[tuple[str, str]] = set()


def prepare(robots: dict[str, Robot], longest: float, shared: Shared) -> None:
    """What is done once in a process."""
    accept(robots, longest, shared)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the server says when to end: services signal all


def accept(robots: dict[str, Robot], longest: float, shared: Shared) -> None:
    """Take requests from now on; see `_State`."""
    global _state
    _state = _State(robots, longest, shared)


def warm_up() -> bool:
    """Load, or compile, what most requests need; whether anything was compiled."""
    assert _state is not None
    name, robot = next(iter(_state.robots.items()))
    middle = (robot.lower + robot.upper) / 2
    far = Scene([Box([2.0, 2.0, 2.0], [0.1, 0.1, 0.1])])
    _warmed(_planner(DEFAULT_PLANNER), Problem(robot, far, middle, middle + 0.1), name)
    return compile_seconds() > 0


def respond(number: int, what: str, body: bytes) -> Answer:
    """The answer to a request; raises Cancelled if its call is cancelled by its number."""
    state = _state
    assert state is not None

    def leave() -> None:
        if state.shared.cancelled == number:
            raise Cancelled

    try:
        with left_by(leave):
            leave()  # told so before it began
            answer = (_plan if what == PLAN else _validator)(state, body)
        return answer._replace(memory=_memory())
    except InputError as error:
        return failed(400, str(error))
    except Exception as error:
        traceback.print_exc(file=sys.stderr)
        return failed(500, f"{type(error).__name__}: {shortened(str(error))}")


def _memory() -> int:
    """What this process holds [bytes]; 0 where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def failed(code: int, message: str) -> Answer:
    """An error as its one line."""
    line = " ".join(message.split())
    return Answer(code, json.dumps({"error": line}).encode() + b"\n", "")


def _record(body: bytes) -> object:
    try:
        text = body.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"the request is not UTF-8 text: byte {error.start}") from None
    return parse_json(text, "the request")


def _plan(state: _State, body: bytes) -> Answer:
    asked = check_fields("the request", _record(body), ("problem",), ARGUMENTS)
    problem = problem_from_record(asked["problem"], state.robots)
    given = {name: value for name, value in asked.items() if name not in ("problem", "planner")}
    time_limit, seed = given.get("time_limit", TIME_LIMIT), given.get("seed", SEED)
    for name, value in given.items():
        _check_kind(name, value)
    if not 0 < time_limit <= state.longest:
        most = f"it must be above 0 and at most {state.longest:g} s here"
        raise InputError(f"time_limit is {shown(time_limit)}; {most}")
    if not isinstance(seed, int) or not 0 <= seed <= LARGEST_SEED:
        raise InputError(f"seed is {shown(seed)}; it must be a whole number from 0 to {LARGEST_SEED}")
    planner = _planner(asked.get("planner", DEFAULT_PLANNER))
    planner.prepare(problem.robot)
    planner.load_wanted(problem.robot)
    PlanRequest(**given)
    _warmed(planner, problem, asked["problem"]["robot"])
    state.shared.due = time.monotonic() + time_limit + GRACE
    result: PlanResult = planner.plan(problem, **given)
    return _answer(result.record(), result.status.value)


ARGUMENTS = ("planner", *(field.name for field in fields(PlanRequest)))
"""Of a request to plan, besides its problem."""


def _check_kind(name: str, value: object) -> None:
    """`until` is a text, all other arguments are numbers."""
    if name == "until" and not isinstance(value, str):
        raise unknown_name(name, value, UNTIL)
    if name != "until" and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise InputError(f"{name} is {shown(value)}; it must be a number")


def _planner(name: object) -> Planner:
    """A planner that requests name, loaded once."""
    PLANNERS.entry(name)
    return _loaded(str(name))


@lru_cache(maxsize=64)
def _loaded(name: str) -> Planner:
    return load_planner(name)


def _warmed(planner: Planner, problem: Problem, robot: str) -> None:
    """Compile, or load compiled code, before the clock starts."""
    if (planner.name, robot) not in _warm:
        planner.warm_up(problem)
        _warm.add((planner.name, robot))


def _validator(state: _State, body: bytes) -> Answer:
    values = check_fields("the request", _record(body), ("problem",), MOTIONS)
    problem = problem_from_record(values["problem"], state.robots)
    motions = {name: read_motion(name, values[name]) for name in MOTIONS if name in values}
    if not motions:
        raise InputError("the request has neither path nor trajectory")
    state.shared.due = time.monotonic() + state.longest + GRACE
    validator = Verifier(problem)
    reports: dict[str, Report] = {}
    for name, motion in motions.items():
        check_left()
        reports[name] = getattr(validator, name)(motion)
    valid = all(report.valid for report in reports.values())
    record = {"valid": valid} | {name: report_record(report) for name, report in reports.items()}
    return _answer(record, "valid" if valid else "invalid")


def _answer(record: dict[str, Any], status: str) -> Answer:
    return Answer(200, orjson.dumps(record, option=orjson.OPT_APPEND_NEWLINE), status)
