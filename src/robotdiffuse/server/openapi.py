"""The interface of a server in words: what OpenAPI says of each path, and a page of it without scripts."""

import json
from html import escape
from typing import Any

from robotdiffuse.core.types import UNTIL, Status
from robotdiffuse.trajectories.speed_limits import MIN_JERK, MIN_SCALING

ABOUT = (
    "Motion planning for redundant robot arms; every motion that is answered passed the validator. Metres, "
    'radians, seconds; quaternions wxyz. Errors are one line: {"error": "..."}. Problems are those of '
    "problem files in JSON: they name a robot of /robots and hold all that they need, for files are not "
    "read. A header X-Request-ID names a request, so that DELETE /requests/{name} can end it; closing the "
    "connection ends it too."
)
PROBLEM: dict[str, Any] = {
    "robot": "panda",
    "scene": [{"box": {"center": [0.45, 0.0, 0.3], "size": [0.3, 0.05, 0.6], "name": "wall"}}],
    "start": [0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785],
    "goal": {"joints": [-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785]},
}
NUMBER, TEXT, ROWS = (
    {"type": "number"},
    {"type": "string"},
    {"type": "array", "items": {"type": "array", "items": {"type": "number"}}},
)
NAMES = {"type": "array", "items": TEXT}
ERROR = {"type": "object", "properties": {"error": TEXT}, "required": ["error"]}


def _object(required: tuple[str, ...], example: Any = None, **properties: Any) -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "object", "properties": properties, "required": list(required)}
    schema["additionalProperties"] = False
    return schema if example is None else schema | {"example": example}


PLAN_REQUEST = _object(
    ("problem",),
    {"problem": PROBLEM, "planner": "robotdiffuse", "time_limit": 1.0, "seed": 0},
    problem={"type": "object", "description": "as in a problem file"},
    planner=TEXT | {"description": "one of /planners", "default": "robotdiffuse"},
    time_limit=NUMBER | {"description": "[s]", "exclusiveMinimum": 0, "default": 1.0},
    seed={"type": "integer", "minimum": 0, "default": 0},
    until=TEXT | {"enum": list(UNTIL), "default": "short"},
    clearance=NUMBER | {"description": "to keep where it can be kept [m]", "minimum": 0},
    velocity_scaling=NUMBER | {"minimum": MIN_SCALING, "maximum": 1, "default": 1.0},
    acceleration_scaling=NUMBER | {"minimum": MIN_SCALING, "maximum": 1, "default": 1.0},
    jerk=NUMBER | {"description": "most of any joint [rad/s³]", "minimum": MIN_JERK},
)
PATH = _object(("joint_names", "positions"), joint_names=NAMES, positions=ROWS)
TRAJECTORY = _object(
    ("joint_names", "times", "positions", "velocities", "accelerations"),
    joint_names=NAMES,
    times={"type": "array", "items": NUMBER},
    positions=ROWS,
    velocities=ROWS,
    accelerations=ROWS,
)
ENDS = [PROBLEM["start"], PROBLEM["goal"]["joints"]]
VERIFY_REQUEST = _object(
    ("problem",),
    {
        "problem": PROBLEM,
        "path": {"joint_names": [f"panda_joint{i}" for i in range(1, 8)], "positions": ENDS},
    },
    problem={"type": "object", "description": "as in a problem file"},
    path=PATH,
    trajectory=TRAJECTORY,
)
RESULT = {
    "type": "object",
    "description": "as in a result file of `robotdiffuse plan --out`",
    "properties": {
        "status": {"type": "string", "enum": [status.value for status in Status]},
        "reason": TEXT,
        "verified": {"type": "boolean"},
        "waypoints": ROWS | {"type": ["array", "null"]},
        "times": {"type": "array", "items": NUMBER},
        "positions": ROWS,
        "velocities": ROWS,
        "accelerations": ROWS,
    },
    "required": ["status", "reason", "verified"],
}
VERDICT = {
    "type": "object",
    "properties": {
        "valid": {"type": "boolean"},
        "path": {"type": "object"},
        "trajectory": {"type": "object"},
    },
    "required": ["valid"],
}
ERRORS = {
    400: "the request is wrong",
    401: "the token is missing",
    408: "the request did not arrive in time",
    409: "the request was cancelled, or its name is taken",
    413: "the request is too large",
    415: "the content is of another kind",
    421: "the host is another one",
    429: "the queue is full; Retry-After says when to come again",
    500: "the worker died of the request",
    503: "the server stops, or the request took too long",
}
LIST = {"type": "array", "items": {"type": "object"}}


def _answers(kind: str, schema: dict[str, Any], what: str, errors: tuple[int, ...]) -> dict[str, Any]:
    responses: dict[int | str, Any] = {200: {"description": what, "content": {kind: {"schema": schema}}}}
    for code in errors:
        responses[code] = {
            "description": ERRORS[code],
            "content": {"application/json": {"schema": ERROR}},
        }
    return {"responses": responses}


def _takes(kind: str, schema: dict[str, Any]) -> dict[str, Any]:
    name = {
        "name": "X-Request-ID",
        "in": "header",
        "required": False,
        "schema": {"type": "string", "maxLength": 100},
        "description": "names the request for DELETE /requests/{name}",
    }
    body = {"required": True, "content": {kind: {"schema": schema}}}
    return {"openapi_extra": {"requestBody": body, "parameters": [name]}}


JSON, LINES = "application/json", "application/x-ndjson"
ALWAYS, WORK = (401, 421), (400, 401, 408, 409, 413, 415, 421, 429, 500, 503)
PLAN = _answers(JSON, RESULT, "the result", WORK) | _takes(JSON, PLAN_REQUEST)
VERIFY = _answers(JSON, VERDICT, "the verdict", WORK) | _takes(JSON, VERIFY_REQUEST)
BATCH = _answers(LINES, RESULT, "a result or an error in each line", WORK)
BATCH |= _takes(LINES, {"type": "string", "description": "a request of /plan in each line"})
DELETE = _answers(JSON, {"type": "object"}, "it ends", ALWAYS)
DELETE["responses"][404] = {
    "description": "there is none",
    "content": {JSON: {"schema": ERROR}},
}
ROBOTS = _answers(JSON, LIST, "names, joints and their limits, links", ALWAYS)
PLANNERS = _answers(JSON, LIST, "names and what they do", ALWAYS)
HEALTH = _answers(JSON, {"type": "object"}, "requests are taken", ALWAYS)
HEALTH["responses"][503] = {
    "description": "they are not",
    "content": {JSON: {"schema": {"type": "object"}}},
}
METRICS = _answers("text/plain", TEXT, "counts", ALWAYS)
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
section { border-top: 1px solid #8884; padding: .5rem 0; }
code, pre { font: 13px/1.5 ui-monospace, monospace; background: #8881; border-radius: 4px; }
code { padding: .1em .3em; }
pre { padding: .7rem; overflow-x: auto; }
h2 { font-size: 1.1rem; } h2 b { color: #3949ab; }
td { padding: .1rem 1rem .1rem 0; vertical-align: top; }
:root { color-scheme: light dark; } @media (prefers-color-scheme: dark) { h2 b { color: #9fa8da; } }
"""


def html(openapi: dict[str, Any]) -> str:
    """A page of what the server answers, from its OpenAPI description."""
    sections = "".join(
        _section(method, path, operation)
        for path, methods in openapi["paths"].items()
        for method, operation in methods.items()
    )
    about = openapi["info"]
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(about['title'])}</title>"
        f"<meta name=viewport content='width=device-width'><style>{STYLE}</style>"
        f"<h1>{escape(about['title'])} {escape(about['version'])}</h1><p>{escape(about['description'])}</p>"
        f"<p>For programs: <a href=openapi.json>openapi.json</a></p>{sections}</html>"
    )


def _section(method: str, path: str, operation: dict[str, Any]) -> str:
    content = operation.get("requestBody", {}).get("content", {})
    takes = ""
    for kind, body in content.items():
        rows = "".join(_row(name, of) for name, of in body["schema"].get("properties", {}).items())
        example = body["schema"].get("example")
        shown = "" if example is None else f"<pre>{escape(json.dumps(example, indent=1))}</pre>"
        takes += f"<p>takes <code>{kind}</code></p><table>{rows}</table>{shown}"
    answers = "".join(
        f"<tr><td><code>{code}</code><td>{escape(answer['description'])}"
        for code, answer in operation["responses"].items()
        if "description" in answer
    )
    title = f"<h2><b>{method.upper()}</b> <code>{escape(path)}</code></h2>"
    about = escape(" ".join(operation.get("description", "").split()))
    return f"<section>{title}<p>{about}</p>{takes}<p>answers</p><table>{answers}</table></section>"


def _row(name: str, of: dict[str, Any]) -> str:
    about = [of.get("description", "")]
    about += [f"one of {', '.join(of['enum'])}"] if "enum" in of else []
    about += [f"default {of['default']}"] if "default" in of else []
    text = "; ".join(part for part in about if part)
    return f"<tr><td><code>{name}</code><td>{of['type']}<td>{escape(text)}"
