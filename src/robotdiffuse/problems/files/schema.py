"""The JSON schema of problem files, for editors that complete and check them.

It is made of the tables by which files are read, so that it has every shape and constraint. It says what
fields there are; `load_problem` says what is right.
"""

from dataclasses import MISSING, fields
from typing import Any

from robotdiffuse.problems.constraints import CONSTRAINTS, PositionBox
from robotdiffuse.problems.files.goals import TOLERANCES
from robotdiffuse.problems.problem import UNKNOWN_POLICIES
from robotdiffuse.robots import ROBOTS
from robotdiffuse.scenes.files import FILE_CONTENT, SHAPES
from robotdiffuse.scenes.scene import ALL_LINKS

Schema = dict[str, Any]
NUMBER: Schema = {"type": "number"}
TEXT: Schema = {"type": "string"}
NUMBERS: Schema = {"type": "array", "items": NUMBER}
ROWS: Schema = {"type": "array", "items": NUMBERS}
FIELDS: dict[str, Schema] = {
    **dict.fromkeys(("name", "file", "frame"), TEXT),
    **dict.fromkeys(("points", "vertices", "faces", "heights"), ROWS),
    **dict.fromkeys(
        ("center", "size", "xyz", "axis", "direction", "normal", "point", "low", "high"), NUMBERS
    ),
}
"""Fields of shapes and constraints that are no single numbers."""


def problem_schema() -> Schema:
    """The schema of a problem file, as JSON values."""
    goal = {"$ref": "#/$defs/goal"}
    properties: Schema = {
        "robot": {"type": "string", "description": f"a URDF file, an added robot, or {', '.join(ROBOTS)}"},
        "locked": {"type": "object", "additionalProperties": NUMBER},
        "base": _pose(),
        "tool": _object(
            {"link": TEXT, "name": TEXT, **_turn(), "shapes": _list("shape"), "touch_links": _texts()}
        ),
        "attached": {"type": "array", "items": {"type": "object", "required": ["link"]}},
        "scene": {"oneOf": [_list("shape"), {"type": "string", "description": "a MoveIt planning scene"}]},
        "request": {
            "type": "string",
            "description": "a MoveIt motion plan request, in place of start and goal",
        },
        "start": {"oneOf": [NUMBERS, TEXT], "description": "joint values [rad or m], or a named pose"},
        "goal": goal,
        "waypoints": {"type": "array", "items": goal},
        "blend": {"oneOf": [NUMBER, NUMBERS]},
        "constraints": {"type": "array", "items": _one_of(_constraints())},
        "clearance": {"type": "number", "minimum": 0, "maximum": 0.5, "description": "[m]"},
        "views": {"type": "array", "items": {"type": "object", "required": ["camera"]}},
        "unknown": {"enum": list(UNKNOWN_POLICIES)},
        "moving": {"type": "array", "items": {"type": "object"}},
        "start_velocity": NUMBERS,
        "allowed_contacts": {
            "type": "object",
            "additionalProperties": {"oneOf": [_texts(), {"const": ALL_LINKS}]},
            "description": "obstacles, each with the links that may touch it",
        },
        "payload": _object({"mass": NUMBER, "com": NUMBERS, "link": TEXT, "moments": NUMBERS}, ["mass"]),
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "RobotDiffuse problem",
        **_object(properties, ["robot", "scene"]),
        "anyOf": [{"required": ["start", "goal"]}, {"required": ["request"]}],
        "$defs": {"shape": _one_of(_shapes()), "goal": _goal(goal), "pose": _goal_pose([])},
    }


def _shapes() -> dict[str, Schema]:
    """What each kind of shape may hold."""
    found = {}
    for kind, shape in SHAPES.items():
        names = [field.name for field in fields(shape)]  # type: ignore[arg-type]
        needed = [field.name for field in fields(shape) if field.default is MISSING]  # type: ignore[arg-type]
        properties = {name: FIELDS.get(name, NUMBER) for name in names if name != "wxyz"}
        if kind not in FILE_CONTENT:
            found[kind] = _object(properties | (_turn() if "wxyz" in names else {}), needed)
            continue
        outside = [name for name in needed if name not in FILE_CONTENT[kind]]
        whole = _object(properties | (_turn() if "wxyz" in names else {}))
        found[kind] = whole | {"anyOf": [{"required": needed}, {"required": ["file", *outside]}]}
    return found


def _constraints() -> dict[str, Schema]:
    found = {}
    for kind, constraint in CONSTRAINTS.items():
        given = [field for field in fields(constraint) if field.name != "T_base_box"]
        properties = {field.name: FIELDS.get(field.name, NUMBER) for field in given}
        needed = [field.name for field in given if field.default is MISSING]
        found[kind] = _object(properties | (_turn() if constraint is PositionBox else {}), needed)
    return found


def _goal(goal: Schema) -> Schema:
    several = {"type": "object", "additionalProperties": {"$ref": "#/$defs/pose"}}
    kinds = {
        "joints": {"oneOf": [NUMBERS, TEXT]},
        "joint_set": ROWS,
        "pose": _goal_pose(["frame"]),
        "poses": several,
        "any": {"type": "array", "items": goal},
    }
    lists = {"type": "array", "items": {"anyOf": [NUMBER, goal]}}
    return {"anyOf": [TEXT, lists, _one_of(kinds)]}


def _goal_pose(needed: list[str]) -> Schema:
    return _object(
        {"frame": TEXT, "relative_to": TEXT, **_turn(), **dict.fromkeys(TOLERANCES, NUMBERS)}, needed
    )


def _pose() -> Schema:
    return _object(_turn())


def _turn() -> Schema:
    """Position and orientation."""
    quaternion = NUMBERS | {"minItems": 4, "maxItems": 4, "description": "quaternion, scalar first"}
    angles = NUMBERS | {"minItems": 3, "maxItems": 3, "description": "roll, pitch, yaw [rad], as in URDFs"}
    return {"xyz": NUMBERS | {"minItems": 3, "maxItems": 3}, "wxyz": quaternion, "rpy": angles}


def _object(properties: Schema, required: list[str] | None = None) -> Schema:
    return {
        "type": "object",
        "properties": properties,
        "required": required or [],
        "additionalProperties": False,
    }


def _one_of(kinds: dict[str, Schema]) -> Schema:
    """A mapping of exactly one of these names to what it may hold."""
    return _object(kinds) | {"minProperties": 1, "maxProperties": 1}


def _list(name: str) -> Schema:
    return {"type": "array", "items": {"$ref": f"#/$defs/{name}"}}


def _texts() -> Schema:
    return {"type": "array", "items": TEXT}
