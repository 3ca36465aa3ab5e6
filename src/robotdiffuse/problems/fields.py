"""The fields of problem files: how each is read, written, moved between frames and described.

Examples of the less simple fields:

base: {xyz: [0, 0, 0.7], wxyz: [1, 0, 0, 0]}
tool: {link: panda_hand, xyz: [0, 0, 0.15], shapes: [{cylinder: {...}}]}
attached:
  - {link: panda_hand, box: {center: [0, 0, 0.12], size: [0.05, 0.05, 0.1], name: cup}}
goal: [...], the name of a pose of the robot, or one of
  {joints: [...]}
  {joint_set: [[...], [...]]}
  {pose: {frame: panda_hand, xyz: [...], wxyz: [...]}}
  {pose: {..., relative_to: shelf, xyz_tolerance: [0.1, 0.1, 0], rpy_tolerance: [0, 0, 3.1416]}}
  {poses: {left_gripper: {xyz: [...], wxyz: [...]}, right_gripper: {...}}}
  {any: [{pose: {...}}, {joints: [...]}]}
constraints:
  - axis_cone: {frame: panda_hand, axis: [0, 0, 1], direction: [0, 0, -1], angle: 0.1745}
  - position_box: {frame: panda_hand, low: [0.2, -0.5, 0.1], high: [0.7, 0.5, 0.9], xyz: ..., wxyz: ...}
  - on_plane: {frame: panda_hand, point: [0, 0, 0.4], normal: [0, 0, 1], tolerance: 0.002}
  - on_line: {frame: panda_hand, point: [0.5, 0, 0.4], direction: [0, 1, 0], tolerance: 0.002}
  - cartesian_line: {frame: panda_hand, tolerance: 0.001, angle: 0.05, speed: 0.1}
moving:
  - {sphere: {center: [0.5, -0.6, 0.5], radius: 0.1}, velocity: [0, 0.3, 0]}
  - {box: {center: [0.6, 0, 0.3], size: [0.2, 0.2, 0.2]}, times: [0, 2], poses: [{xyz: [0.6, 0, 0.3]}, {...}]}
  - {sphere: {center: [0.5, 0.6, 0.5], radius: 0.1, name: hand}, max_speed: 0.5}
payload: {mass: 1.5, com: [0, 0, 0.12], link: panda_hand}
"""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robotdiffuse.core.errors import (
    InputError,
    check_name,
    check_type,
    filled_text,
    located,
    numbers,
    shown,
    unit_quaternion,
    vector,
)
from robotdiffuse.core.files import JsonObject
from robotdiffuse.core.settings import converted
from robotdiffuse.core.transforms import pose_entry, rotation_from_quaternion, transform
from robotdiffuse.core.types import Pose
from robotdiffuse.perception.depth_view_files import read_views, view_entry
from robotdiffuse.problems.constraints import CONSTRAINTS, Constraint
from robotdiffuse.problems.problem import (
    UNKNOWN_POLICIES,
    AnyGoal,
    Goal,
    JointGoal,
    PoseGoal,
    PosesGoal,
    check_clearance,
)
from robotdiffuse.robots import ROBOTS
from robotdiffuse.robots.bodies import TOOL, Payload
from robotdiffuse.robots.robot import Robot, named_pose
from robotdiffuse.scenes.files import (
    FILE_CONTENT,
    SHAPES,
    check_fields,
    contacts_entry,
    only_field,
    plain_fields,
    read_scene,
    read_shape,
    required_fields,
    scene_entries,
)
from robotdiffuse.scenes.scene import ALL_LINKS, MovingObstacle, Scene
from robotdiffuse.scenes.shapes import IDENTITY, Shape

Schema = JsonObject
NUMBER: Schema = {"type": "number"}
TEXT: Schema = {"type": "string"}
OBJECT: Schema = {"type": "object"}


def _array(items: Schema, size: int | None = None) -> Schema:
    """The schema of a list, of exactly `size` items if it is given."""
    return {"type": "array", "items": items} | ({} if size is None else {"minItems": size, "maxItems": size})


def _object(properties: Schema, *required: str) -> Schema:
    return OBJECT | {"properties": properties, "required": [*required], "additionalProperties": False}


def _one_of(kinds: Schema) -> Schema:
    """The schema of a mapping with exactly one of these names as its key."""
    return _object(kinds) | {"minProperties": 1, "maxProperties": 1}


NUMBERS = _array(NUMBER)
TEXTS = _array(TEXT)
ROWS = _array(NUMBERS)
SHAPE, GOAL, POSE_OF_LINK = ({"$ref": f"#/$defs/{name}"} for name in ("shape", "goal", "pose"))
VALUES: dict[str, Schema] = {
    **dict.fromkeys(("name", "file", "frame"), TEXT),
    **dict.fromkeys(("points", "vertices", "faces"), ROWS),
    "heights": _array(_array({"type": ["number", "null"]})),
    **dict.fromkeys(
        ("center", "size", "xyz", "axis", "direction", "normal", "point", "low", "high"), NUMBERS
    ),
}
"""Schemas of the fields of shapes and constraints whose values are not single numbers."""
POSE = {
    "xyz": _array(NUMBER, 3),
    "wxyz": _array(NUMBER, 4) | {"description": "quaternion, scalar first"},
    "rpy": _array(NUMBER, 3) | {"description": "roll, pitch, yaw [rad], as in URDFs"},
}
TOLERANCES = ("xyz_tolerance", "rpy_tolerance")
LINK_POSE = {"relative_to": TEXT, **POSE, **dict.fromkeys(TOLERANCES, NUMBERS)}
GOAL_POSE = {"frame": TEXT, **LINK_POSE}
GOALS = {
    "joints": {"oneOf": [NUMBERS, TEXT]},
    "joint_set": ROWS,
    "pose": _object(GOAL_POSE, "frame"),
    "poses": OBJECT | {"additionalProperties": POSE_OF_LINK},
    "any": _array(GOAL),
}
TOOL_FIELDS = {"link": TEXT, "name": TEXT, **POSE, "shapes": _array(SHAPE), "touch_links": TEXTS}
PAYLOAD_FIELDS = {"mass": NUMBER, "com": NUMBERS, "link": TEXT, "moments": NUMBERS}
MOTION_FIELDS = ("velocity", "times", "poses", "max_speed")
WRITTEN_DECIMALS = 15
"""Decimals of computed poses and points in files. Rounding restores most values up to about 1 that a user
wrote, e.g. 0.3 for 0.30000000000000004. With fewer decimals, a cloud that is read from the file would have
another hash than the cloud that was written."""


def _fields_of(kind: type) -> tuple[dict[str, Schema], list[str]]:
    """Schemas of the fields of a shape or constraint in a file, by name, and its required fields."""
    schemas = dict[str, Schema]()
    for field in fields(kind):
        if field.name == "T_base_box":
            schemas |= POSE
        elif field.name == "wxyz":
            schemas |= {name: POSE[name] for name in ("wxyz", "rpy")}
        else:
            schemas[field.name] = VALUES.get(field.name, NUMBER)
    return schemas, required_fields(kind)


def _entry_schema(kind: type[Shape] | type[Constraint]) -> Schema:
    field_schemas, required = _fields_of(kind)
    content = FILE_CONTENT.get(kind.kind)
    if content is None:
        return _object(field_schemas, *required)
    in_file = ["file", *(name for name in required if name not in content)]
    return _object(field_schemas) | {"anyOf": [{"required": required}, {"required": in_file}]}


def read_pose(where: str, data: object) -> Pose:
    """The transform of an entry {xyz: [...], wxyz: [...]}, or with rpy in place of wxyz; all fields are
    optional. Raises InputError for anything else."""
    return pose_of(where, check_fields(where, data, (), POSE))


def pose_of(where: str, values: JsonObject) -> Pose:
    """The transform of the fields xyz and wxyz, both optional; other fields are ignored. `check_fields` has
    converted rpy to wxyz."""
    xyz = vector(where, "xyz", values.get("xyz", (0.0, 0.0, 0.0)), 3)
    return transform(xyz, rotation_from_quaternion(unit_quaternion(where, values.get("wxyz", IDENTITY))))


def entries_of(where: str, data: Any, what: str) -> list[tuple[str, Any]]:
    """The entries of a list, each with its place for messages. Raises InputError for anything else, with a
    message that says what the list should hold (`what`)."""
    check_type(where, data, list, f"a list of {what}")
    return [(f"{where}[{i}]", entry) for i, entry in enumerate(data)]


def rounded(value: Any) -> Any:
    """Plain data with its numbers rounded to WRITTEN_DECIMALS decimals."""
    if isinstance(value, float):
        return round(value, WRITTEN_DECIMALS) + 0.0
    if isinstance(value, list):
        return [rounded(item) for item in value]
    return {key: rounded(item) for key, item in value.items()} if isinstance(value, dict) else value


def _touch_links(where: str, entry: JsonObject) -> tuple[str, ...]:
    return converted(f"{where}.touch_links", tuple[str, ...], entry.get("touch_links", ()))


def equipped(robot: Robot, values: JsonObject, folder: Path, notes: list[str]) -> Robot:
    """The robot with the tool and the attached objects of a problem file.

    folder: file names of meshes are relative to it. notes: notes on the shapes are added to this list. Raises
    InputError that names the field, for unknown fields and for values that `Robot.attach` does not accept.
    """
    waiting = None
    needed = set[str]()
    if values.get("tool") is not None:
        tool = check_fields("tool", values["tool"], ("link",), TOOL_FIELDS)
        shapes, shape_notes = read_scene(tool.get("shapes", []), folder, field="tool.shapes")
        notes += shape_notes
        link = filled_text("tool.link", tool["link"], "a name")
        name = filled_text("tool.name", tool.get("name", TOOL), "a name")
        touch = _touch_links("tool", tool)
        waiting = link, pose_of("tool", tool), shapes.shapes, touch, name
        needed = {link, *touch}
    attached = values.get("attached")
    objects = [] if attached is None else attached
    for location, entry in entries_of("attached", objects, "objects, each with a link"):
        if not isinstance(entry, dict) or "link" not in entry:
            raise InputError(
                f"{location} is {shown(entry)}; it must be a shape with its link, e.g. "
                "{link: panda_hand, box: {...}}"
            )
        shape = {key: value for key, value in entry.items() if key not in ("link", "touch_links")}
        if waiting is not None and needed <= {*robot.link_names}:
            robot = robot.with_tool(*waiting)
            waiting = None
        with located(location):
            attached_shape = read_shape(location, shape, folder, notes)
            touch = _touch_links(location, entry)
            link = filled_text(f"{location}.link", entry["link"], "a name")
            robot = robot.attach(attached_shape, link, touch)
    # the tool waited for its links, which may be held objects
    return robot if waiting is None else robot.with_tool(*waiting)


def equipment_entries(robot: Robot, folder: Path | None) -> JsonObject:
    """The fields `tool` and `attached` of a robot, in the form that `equipped` reads."""
    entries = JsonObject()
    for body in robot.attached:
        solids = [shape for shape in body.shapes if isinstance(shape, Shape)]
        if len(solids) < len(body.shapes) or not (body.tool or len(solids) == 1):
            raise InputError(
                f"{body.name} has the shapes {shown(body.shapes)}; a problem file holds only shapes of "
                "scenes, and exactly one for each attached object"
            )
        shapes = scene_entries(Scene(solids), folder)
        touch = {"touch_links": list(body.touch_links)} if body.touch_links else {}
        if body.tool:
            at = {"link": body.link, "name": body.name, **rounded(pose_entry(body.T_link_body))}
            entries["tool"] = at | ({"shapes": shapes} if shapes else {}) | touch
        else:
            entries.setdefault("attached", []).append({"link": body.link, **shapes[0], **touch})
    return entries


class Setting(NamedTuple):
    """What the entries of a problem file may refer to."""

    robot: Robot
    scene: Scene
    folder: Path
    notes: list[str]
    """Notes on changes to the input; the functions that read fields append to this list."""


def read_goal(where: str, data: object, setting: Setting) -> Goal:
    """The goal of an entry of a problem file. Raises InputError that names the field.

    Besides the mappings in GOALS, the entry may be what `rd.Problem` accepts: a configuration, a list of
    configurations, the name of a pose of the robot, or a list of goals, any of which may be reached.

    Poses are in the frame of the scene, or in the frame of the object that `relative_to` names.
    """
    if isinstance(data, str):
        return JointGoal(named_pose(setting.robot, where, data))
    if isinstance(data, list):
        kind = "joint_set" if data and all(isinstance(part, list) for part in data) else "joints"
        data = {"any" if any(isinstance(part, dict | str) for part in data) else kind: data}
    kind, value = only_field(where, data, GOALS, "a configuration, or a mapping with one field")
    where = f"{where}.{kind}"
    if kind == "any":
        if not isinstance(value, list) or not value:
            raise InputError(f"{where} is {shown(value)}; it must be a non-empty list of goals")
        return AnyGoal(tuple(read_goal(*entry, setting) for entry in entries_of(where, value, "goals")))  # type: ignore[arg-type]
    if kind == "pose":
        return _pose_goal(where, value, setting.scene)
    if kind == "poses":
        if not isinstance(value, dict) or not value:
            raise InputError(f"{where} is {shown(value)}; it must map link names to poses")
        return PosesGoal(
            [_pose_goal(f"{where}.{frame}", part, setting.scene, frame) for frame, part in value.items()]
        )
    if kind == "joints" and isinstance(value, str):
        value = named_pose(setting.robot, where, value)
    array = numbers(value)
    if array is None or array.ndim != (1 if kind == "joints" else 2):
        form = "a list of numbers" if kind == "joints" else "a list of configurations of one length"
        raise InputError(f"{where} is {shown(value)}; it must be {form}")
    with located(where):
        return JointGoal(array)


def _pose_goal(where: str, value: object, scene: Scene, frame: object = None) -> PoseGoal:
    """The goal of a pose entry. frame: the link; None: the entry names it."""
    pose_fields = GOAL_POSE if frame is None else LINK_POSE
    required = [name for name in ("frame", "xyz", "wxyz") if name in pose_fields]
    pose = {"frame": frame, **check_fields(where, value, required, pose_fields)}
    T = pose_of(where, pose)
    if "relative_to" in pose:
        shapes = {shape.name: shape for shape in scene.shapes}
        name = pose["relative_to"]
        check_name(f"object in {where}.relative_to:", name, shapes)
        with located(f"{where}.relative_to"):
            T = shapes[name].T_base_shape @ T
    with located(where):
        return PoseGoal(pose["frame"], T, *(pose.get(name) for name in TOLERANCES))  # type: ignore[arg-type]


def goal_entry(goal: Goal) -> JsonObject:
    """The entry of a goal, in the form that `read_goal` reads."""
    if isinstance(goal, AnyGoal):
        return {"any": [goal_entry(part) for part in goal.goals]}
    if isinstance(goal, JointGoal):
        rows = goal.positions.tolist()
        return {"joints": rows[0]} if len(rows) == 1 else {"joint_set": rows}
    if isinstance(goal, PosesGoal):
        return {"poses": {pose.frame: _pose_goal_entry(pose) for pose in goal.poses}}
    return {"pose": {"frame": goal.frame, **_pose_goal_entry(goal)}}


def _pose_goal_entry(pose: PoseGoal) -> JsonObject:
    tolerances = {name: getattr(pose, name) for name in TOLERANCES}
    tolerance_entry = {name: value.tolist() for name, value in tolerances.items() if value is not None}
    return {**pose_entry(pose.T_base_frame), **tolerance_entry}


def _constraint(where: str, entry: object) -> Constraint:
    name, raw_fields = only_field(where, entry, CONSTRAINTS, "one constraint, e.g. {axis_cone: {...}}")
    field_schemas, required = _fields_of(CONSTRAINTS[name])
    at = f"{where}.{name}"
    values = dict(check_fields(at, raw_fields, required, field_schemas))
    posed = {key: values.pop(key) for key in ("xyz", "wxyz") if key in values}
    if posed:
        values["T_base_box"] = pose_of(at, posed)
    try:
        return CONSTRAINTS[name](**values)
    except InputError as error:
        raise InputError(f"{where}.{error}") from None


def constraint_entry(constraint: Constraint) -> JsonObject:
    """The entry of a constraint in a problem file."""
    values = plain_fields(constraint, "T_base_box")
    T = getattr(constraint, "T_base_box", None)
    if T is not None and not np.array_equal(T, np.eye(4)):
        values |= pose_entry(T)
    return {constraint.kind: values}


def _moving(where: str, entry: Any, setting: Setting) -> MovingObstacle:
    check_type(where, entry, dict, "a shape and its motion, e.g. {sphere: {...}, velocity: [0, 0.3, 0]}")
    motion = {name: value for name, value in entry.items() if name in MOTION_FIELDS}
    shape = {name: value for name, value in entry.items() if name not in motion}
    if len(shape) != 1 or not shape.keys() <= SHAPES.keys():
        raise InputError(
            f"{where} has the fields {', '.join(map(str, entry))}; it must have one shape of "
            f"{', '.join(SHAPES)}, and a motion of {', '.join(MOTION_FIELDS)}"
        )
    obstacle_shape = read_shape(where, shape, setting.folder, setting.notes)
    with located(where):
        if "poses" in motion:
            poses = entries_of("poses", motion["poses"], "{xyz, wxyz}")
            motion["poses"] = [read_pose(*pose) for pose in poses]
        return MovingObstacle(obstacle_shape, **motion)


def moving_entry(obstacle: MovingObstacle, folder: Path | None) -> JsonObject:
    """The entry of a moving obstacle in a problem file; files of meshes are named relative to `folder`."""
    [shape] = scene_entries(Scene([obstacle.shape]), folder)
    unset = [name for name in MOTION_FIELDS if getattr(obstacle, name) is None]
    motion = plain_fields(obstacle, "shape", "poses", *unset)
    if obstacle.poses is not None:
        motion["poses"] = [pose_entry(T) for T in obstacle.poses]
    return shape | motion


def payload_entry(payload: Payload) -> dict[str, object]:
    """The entry of a payload in a problem file."""
    is_set = {"link": payload.link is not None, "moments": payload.moments.any()}
    return plain_fields(payload, *(name for name in is_set if not is_set[name]))


def _views(data: object, setting: Setting) -> Any:
    views, notes = read_views(data, setting.folder)
    setting.notes.extend(notes)
    return views


class Field(NamedTuple):
    """How problem files hold a field of `Problem`."""

    schema: Schema
    read: Callable[[Any, Setting], Any] = lambda data, setting: data
    """Converts the plain data of a file to the argument for `Problem`."""
    write: Callable[[Any, Path | None], Any] = lambda value, folder: (
        value.tolist() if isinstance(value, np.ndarray) else value
    )
    """Converts the field's value to plain data; names of files are relative to the folder."""
    in_world: bool = False
    """Whether files give the value in the frame of the world."""
    with_request: bool = True
    """Whether a problem file may give the field beside a MoveIt request."""


FIELDS = {
    "scene": Field(
        {"oneOf": [_array(SHAPE), TEXT | {"description": "a MoveIt planning scene"}]},
        write=scene_entries,
        in_world=True,
    ),
    "start": Field(
        {
            "oneOf": [NUMBERS, TEXT, OBJECT | {"additionalProperties": NUMBER}],
            "description": "joint values [rad or m], as a list or by joint, or a named pose",
        },
        with_request=False,
    ),
    "goal": Field(
        GOAL,
        lambda data, setting: read_goal("goal", data, setting),
        lambda goal, folder: goal_entry(goal),
        in_world=True,
        with_request=False,
    ),
    "allowed_contacts": Field(
        OBJECT
        | {
            "additionalProperties": {"oneOf": [TEXTS, {"const": ALL_LINKS}]},
            "description": "obstacles, each with the links that may touch it",
        },
        write=lambda scene, folder: contacts_entry(scene),
    ),
    "waypoints": Field(
        _array(GOAL),
        lambda data, setting: [
            read_goal(*entry, setting) for entry in entries_of("waypoints", data, "goals")
        ],
        lambda goals, folder: [goal_entry(goal) for goal in goals],
        in_world=True,
        with_request=False,
    ),
    "blend": Field(
        {"oneOf": [NUMBER, NUMBERS]},
        write=lambda blend, folder: list(blend) if any(blend) else None,
        with_request=False,
    ),
    "constraints": Field(
        _array(_one_of({kind: _entry_schema(constraint) for kind, constraint in CONSTRAINTS.items()})),
        lambda data, setting: [
            _constraint(*entry) for entry in entries_of("constraints", data, "constraints")
        ],
        lambda constraints, folder: [constraint_entry(constraint) for constraint in constraints],
        in_world=True,
    ),
    "moving": Field(
        _array(OBJECT),
        lambda data, setting: [
            _moving(*entry, setting) for entry in entries_of("moving", data, "shapes with their motions")
        ],
        lambda moving, folder: [moving_entry(obstacle, folder) for obstacle in moving],
        in_world=True,
        with_request=False,
    ),
    "start_velocity": Field(NUMBERS, with_request=False),
    "payload": Field(
        _object(PAYLOAD_FIELDS, "mass"),
        lambda data, setting: Payload(**check_fields("payload", data, ("mass",), PAYLOAD_FIELDS)),
        lambda payload, folder: payload_entry(payload),
    ),
    "clearance": Field(
        NUMBER | {"minimum": 0, "maximum": 0.5, "description": "[m]"},
        lambda data, setting: check_clearance(data),
    ),
    "views": Field(
        _array(OBJECT | {"required": ["camera"]}),
        _views,
        lambda views, folder: [view_entry(view, folder) for view in views],
        in_world=True,
    ),
    "unknown": Field({"enum": list(UNKNOWN_POLICIES)}),
}
"""Fields of `Problem`, and the allowed contacts of its scene, in the order in which files list them."""
SETUP: dict[str, Schema] = {
    "robot": TEXT | {"description": f"a URDF file, an added robot, or {', '.join(ROBOTS)}"},
    "locked": OBJECT | {"additionalProperties": NUMBER},
    "base": _object(POSE),
    "tool": _object(TOOL_FIELDS),
    "attached": _array(OBJECT | {"required": ["link"]}),
    "request": TEXT | {"description": "a MoveIt motion plan request, in place of start and goal"},
}
"""The other fields of files: the robot with what it holds, the pose of its base, and a MoveIt request."""


def problem_schema() -> Schema:
    """The JSON schema of problem files, for editors that complete and check these files.

    It is made from the tables by which files are read. It lists the fields and their types; `load_problem`
    checks more than that.
    """
    shapes = {kind: _entry_schema(shape) for kind, shape in SHAPES.items()}
    goal = {"anyOf": [TEXT, _array({"anyOf": [NUMBER, GOAL]}), _one_of(GOALS)]}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "RobotDiffuse problem",
        **_object(SETUP | {name: field.schema for name, field in FIELDS.items()}, "robot", "scene"),
        "anyOf": [{"required": ["start", "goal"]}, {"required": ["request"]}],
        "$defs": {
            "shape": _one_of(shapes),
            "goal": goal,
            "pose": _object(LINK_POSE),
        },
    }
