"""Worker process of a server: turns the body of a request into the body of its answer."""

import json
import os
import resource
import signal
import sys
import time
import traceback
from dataclasses import asdict, fields
from functools import lru_cache
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import orjson

from robotdiffuse.core import loading
from robotdiffuse.core.deadline import cancel_check, check_cancelled
from robotdiffuse.core.errors import InputError, described, shown
from robotdiffuse.core.files import MEGABYTE, JsonObject, decoded, parse_json
from robotdiffuse.core.settings import converted
from robotdiffuse.core.types import RATES, Path, SampleRate, Trajectory, check_motion_arrays
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, load_planner
from robotdiffuse.planning.context import PlanRequest, least_clearances
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.files import problem_from_record
from robotdiffuse.problems.problem import Problem
from robotdiffuse.processes.workers import allow, cancelled, renew
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.files import check_fields
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box
from robotdiffuse.server.settings import GRACE_TIME, ServeSettings
from robotdiffuse.validation.report import Report
from robotdiffuse.validation.validator import Verifier

PLAN = "plan"
VERIFY = "verify"
TOO_LARGE = 413
# Time until a worker is killed [s]: the first while it compiles code for a request, the second while it loads
# code and weights.
COMPILE_TIMEOUT = 300.0
WARM_UP_TIMEOUT = 60.0
MAX_ENTRIES = {
    "scene": 10_000,
    "goal": 1000,
    "waypoints": 200,
    "constraints": 50,
    "moving": 200,
    "views": 20,
    "attached": 50,
}
"""Largest number of entries of the lists of a problem."""
# Largest number of rows of a motion in a request, and in the answer to a request with `rate`.
MAX_ROWS = 100_000
MAX_ANSWER_ROWS = 20_000
MAX_SEED = 2**32 - 1
"""Largest seed that all random generators accept."""


class Answer(NamedTuple):
    """The answer of a worker."""

    code: int
    """HTTP status code."""
    body: bytes
    status: str
    """Status of the result; for verify, valid or invalid; "" for an error."""
    seconds: float = 0.0
    """Time that the worker took [s]."""
    renewed: bool = False
    """Whether the worker is replaced because it holds too much memory."""


class Cancelled(BaseException):
    """The call was canceled."""


# Robots that requests may name
_robots: dict[str, Robot]
_settings: ServeSettings
_warm = set[tuple[str, str]]()


def prepare(robots: dict[str, Robot], settings: ServeSettings) -> bool:
    """Set up a new worker process. Returns whether it compiled code. If so, a new process that loads the code
    from the cache replaces it, so that all workers give the same numbers, bit for bit."""
    accept(robots, settings)
    memory_limit = settings.max_worker_memory
    resource.setrlimit(resource.RLIMIT_DATA, (memory_limit, memory_limit))
    # service managers signal all processes; the server ends its workers itself
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return warm_up()


def accept(robots: dict[str, Robot], settings: ServeSettings) -> None:
    """Accept requests for these robots from now on."""
    global _robots, _settings
    _robots = robots
    _settings = settings


def warm_up() -> bool:
    """Load or compile the code that most requests need; returns whether anything was compiled."""
    name, robot = next(iter(_robots.items()))
    start = robot.middle
    start[1:2] += 0.3  # if the arm pointed straight up, turning its first joint would not move its tip
    goal = start.copy()
    goal[0] += (robot.upper[0] - start[0]) / 2
    far = Scene([Box([2.0, 2.0, 2.0], [0.1, 0.1, 0.1])])
    _warm_up_once(_planner(DEFAULT_PLANNER), Problem(robot, far, start, goal), name)
    return loading.compile_seconds() > 0


def respond(endpoint: str, body: bytes) -> Answer:
    """The answer to a request. Raises Cancelled if the server cancels the call."""
    began = time.monotonic()
    loading.on_first_compilation = lambda: allow(COMPILE_TIMEOUT)
    answer = _answer_of(endpoint, body)
    renewed = answer.code == TOO_LARGE or _memory() > _settings.max_worker_memory / 2
    if renewed:
        renew()
    return answer._replace(seconds=time.monotonic() - began, renewed=renewed)


def _answer_of(endpoint: str, body: bytes) -> Answer:
    try:
        with cancel_check(_raise_if_cancelled):
            check_cancelled()  # the call may have been canceled before it began
            return (answer_plan if endpoint == PLAN else answer_verify)(body)
    except InputError as error:
        return failed(400, str(error))
    except Cancelled:
        raise
    except MemoryError:
        limit_text = f"{_settings.max_worker_memory / MEGABYTE:.0f} MB"
        return failed(TOO_LARGE, f"the request needs more memory than a worker may use, {limit_text}")
    # also a planner's SystemExit, which the server would raise again in its event loop
    except BaseException as error:
        traceback.print_exc(file=sys.stderr)
        return failed(500, described(error))


def _raise_if_cancelled() -> None:
    if cancelled():
        raise Cancelled


def _memory() -> int:
    """Memory of this process [bytes]; 0 if the system does not report it."""
    try:
        pages = int(FilePath("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def failed(code: int, message: str) -> Answer:
    """An error as one line of JSON."""
    return Answer(code, json.dumps({"error": " ".join(message.split())}).encode() + b"\n", "")


def _record(body: bytes) -> object:
    """The JSON value of a body."""
    return parse_json(decoded(body, "the request"), "the request")


def _problem(record: Any) -> Problem:
    """The problem of a request. Raises InputError if it is wrong or too large."""
    for name, max_entries in MAX_ENTRIES.items() if isinstance(record, dict) else ():
        value = record.get(name)
        if name == "goal" and isinstance(value, dict) and len(value) == 1:
            [value] = value.values()
        if isinstance(value, list | dict) and len(value) > max_entries:
            raise InputError(f"problem.{name} has {len(value)} entries; a request may have {max_entries}")
    return problem_from_record(record, _robots)


def answer_plan(body: bytes) -> Answer:
    """The answer to a request to plan. Raises InputError for a bad request."""
    began = time.monotonic()
    requested = check_fields("the request", _record(body), ("problem",), ARGUMENTS)
    call_arguments = {name: value for name, value in requested.items() if name in CALL_ARGUMENTS}
    request = PlanRequest(**call_arguments)
    if request.time_limit > _settings.max_time_limit:
        rule = f"it must be at most {_settings.max_time_limit:g} s here"
        raise InputError(f"time_limit is {shown(request.time_limit)}; {rule}")
    rate = converted("rate", SampleRate | None, requested.get("rate"))
    limit = request.time_limit + GRACE_TIME
    allow(began + limit - time.monotonic())
    problem = _problem(requested["problem"])
    if request.seed > MAX_SEED:
        raise InputError(f"seed is {shown(request.seed)}; it must be at most {MAX_SEED}")
    planner = _planner(requested.get("planner", DEFAULT_PLANNER))
    read_time = time.monotonic() - began
    # warm-up has its own limit; the call then has its limit minus the time that reading took
    allow(WARM_UP_TIMEOUT)
    planner.prepare(problem.robot)
    _warm_up_once(planner, problem, requested["problem"]["robot"])
    allow(limit - read_time)
    result = planner.plan(problem, **call_arguments)
    record = result.record()
    if rate is not None and result.trajectory is not None:
        motion, report = _resampled(problem, result.trajectory, rate)
        record |= motion.record() | {"duration": motion.duration} | least_clearances(result, report)
    return _answer(record, result.status.value)


CALL_ARGUMENTS = tuple(field.name for field in fields(PlanRequest))
ARGUMENTS = ("planner", "rate", *CALL_ARGUMENTS)
"""Fields of a plan request besides its problem."""


def _resampled(problem: Problem, trajectory: Trajectory, rate: float) -> tuple[Trajectory, Report]:
    """The motion with rows at `rate` [Hz], and its report. Raises InputError if the validator rejects it."""
    if trajectory.duration * rate > MAX_ANSWER_ROWS:
        duration = trajectory.duration
        raise InputError(
            f"rate is {rate:g} Hz for {duration:.3g} s; an answer may have {MAX_ANSWER_ROWS} rows"
        )
    rows = trajectory.resample(rate)
    report = Verifier(problem).trajectory(rows)
    if not report.valid:
        raise InputError(
            f"rate is {rate:g} Hz; the motion with these rows is not valid: {report.violation.message}"
        )
    return rows, report


def _planner(name: object) -> Planner:
    """The planner of a name, loaded once. Raises InputError for an unknown name."""
    PLANNERS.entry(name)
    return _loaded(str(name))


_loaded = lru_cache(maxsize=64)(load_planner)


def _warm_up_once(planner: Planner, problem: Problem, robot: str) -> None:
    """Compile or load code before the time limit starts, once for each planner and robot."""
    if (planner.name, robot) not in _warm:
        planner.warm_up(problem)
        _warm.add((planner.name, robot))


def answer_verify(body: bytes) -> Answer:
    """The answer to a request to validate. Raises InputError for a bad request."""
    values = check_fields("the request", _record(body), ("problem",), MOTIONS)
    problem = _problem(values["problem"])
    motions = {name: read_motion(name, values[name]) for name in MOTIONS if values.get(name) is not None}
    if not motions:
        raise InputError("the request has neither path nor trajectory")
    validator = Verifier(problem)
    reports = dict[str, Report]()
    for name, motion in motions.items():
        check_cancelled()
        reports[name] = getattr(validator, name)(motion)
    valid = all(report.valid for report in reports.values())
    record = {"valid": valid} | {name: report_record(report) for name, report in reports.items()}
    return _answer(record, "valid" if valid else "invalid")


def _answer(record: JsonObject, status: str) -> Answer:
    try:
        content = orjson.dumps(record, option=orjson.OPT_APPEND_NEWLINE)
    except TypeError:  # a name with half a surrogate pair, which `json` writes as an escape
        content = json.dumps(record).encode() + b"\n"
    return Answer(200, content, status)


MOTIONS = ("path", "trajectory")


def read_motion(name: str, data: object) -> Path | Trajectory:
    """The motion in a request: `name` is path (joint_names, positions) or trajectory (also times, velocities
    and accelerations).

    Raises InputError, naming the field, for anything else. The validator checks that times increase.
    """
    fields = ("positions", "times", *RATES) if name == "trajectory" else ("positions",)
    values = check_fields(name, data, ("joint_names", *fields))
    rows = values["positions"]
    if isinstance(rows, list) and len(rows) > MAX_ROWS:
        raise InputError(f"{name}.positions has {len(rows)} rows; a request may have {MAX_ROWS}")
    arrays = {field: values[field] for field in fields}
    names, checked = check_motion_arrays(values["joint_names"], arrays, f"{name}.")
    return Trajectory(names, **checked) if name == "trajectory" else Path(names, **checked)


def report_record(report: Report) -> JsonObject:
    """A validation report as JSON values."""
    return {
        "valid": report.valid,
        "min_clearance": report.min_clearance,
        "scene_clearance": report.scene_clearance,
        "self_clearance": report.self_clearance,
        "violation": None if report.violation is None else asdict(report.violation),
    }
