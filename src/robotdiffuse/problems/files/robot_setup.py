"""Reads and writes the robot's setup in problem files: base pose, tool, attached objects and payload.

base: {xyz: [0, 0, 0.7], wxyz: [1, 0, 0, 0]}
tool: {link: panda_hand, xyz: [0, 0, 0.15], shapes: [{cylinder: {...}}]}
attached:
  - {link: panda_hand, box: {center: [0, 0, 0.12], size: [0.05, 0.05, 0.1], name: cup}}
payload: {mass: 1.5, com: [0, 0, 0.12], link: panda_hand}
"""

from pathlib import Path
from typing import Any

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import unit_quaternion, vector
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.transforms import pose_entry, rotation_from_quaternion, transform
from robotdiffuse.robots.bodies import TOOL
from robotdiffuse.robots.inertias import Payload
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.files import check_fields, read_scene, scene_entries
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import IDENTITY, Shape

NO_TRANSLATION = (0.0, 0.0, 0.0)
WRITTEN_DECIMALS = 12
"""Decimals of computed poses in files: enough to restore the values that were read."""


def read_pose(where: str, data: object) -> Float[ndarray, "4 4"]:
    """The transform of {xyz: [...], wxyz: [...]}, both optional. Raises InputError for anything else."""
    return pose_of(where, check_fields(where, data, (), ("xyz", "wxyz")))


def pose_of(where: str, values: dict[str, Any]) -> Float[ndarray, "4 4"]:
    """The transform of the fields xyz and wxyz, both optional; other fields are ignored."""
    xyz = vector(where, "xyz", values.get("xyz", NO_TRANSLATION), 3)
    return transform(xyz, rotation_from_quaternion(unit_quaternion(where, values.get("wxyz", IDENTITY))))


def equipped(robot: Robot, tool: object, attached: object, folder: Path) -> tuple[Robot, tuple[str, ...]]:
    """The robot with the tool and the attached objects of a problem file, and notes.

    tool, attached: the fields of the file, None where it has none. Raises InputError that names the field,
    for unknown fields and whatever `Robot.attach` does not accept.
    """
    notes: list[str] = []
    if tool is not None:
        values = check_fields("tool", tool, ("link",), ("name", "xyz", "wxyz", "shapes", "touch_links"))
        shapes, more = read_scene(values.get("shapes", []), folder, field="tool.shapes")
        notes += more
        T, name = pose_of("tool", values), _text("tool.name", values.get("name", TOOL))
        touch = _names("tool.touch_links", values.get("touch_links", []))
        robot = robot.with_tool(_text("tool.link", values["link"]), T, shapes.shapes, touch, name)
    if attached is not None and not isinstance(attached, list):
        raise InputError(f"attached is {shown(attached)}; it must be a list of objects, each with a link")
    for i, entry in enumerate(attached or []):
        where = f"attached[{i}]"
        if not isinstance(entry, dict) or "link" not in entry:
            raise InputError(
                f"{where} is {shown(entry)}; it must be a shape with its link, e.g. "
                "{link: panda_hand, box: {...}}"
            )
        shape = {key: value for key, value in entry.items() if key not in ("link", "touch_links")}
        try:
            [held], more = one_shape(where, shape, folder)
            notes += more
            touch = _names(f"{where}.touch_links", entry.get("touch_links", []))
            robot = robot.attach(held, _text(f"{where}.link", entry["link"]), touch)
        except InputError as error:
            at = "" if str(error).startswith(where) else f"{where}: "
            raise InputError(f"{at}{error}") from None
    return robot, tuple(notes)


def equipment_entries(robot: Robot, folder: Path | None) -> dict[str, Any]:
    """The fields `tool` and `attached` of a robot, as `equipped` reads them."""
    entries: dict[str, Any] = {}
    for body in robot.attached:
        shapes = scene_entries(Scene([s for s in body.shapes if isinstance(s, Shape)]), folder)
        touch = {"touch_links": list(body.touch_links)} if body.touch_links else {}
        if body.tool:
            at = {"link": body.link, "name": body.name, **rounded(pose_entry(body.T_link_body))}
            entries["tool"] = at | ({"shapes": shapes} if shapes else {}) | touch
        else:
            entries.setdefault("attached", []).append({"link": body.link, **shapes[0], **touch})
    return entries


def rounded(value: Any) -> Any:
    """Plain data with its numbers rounded to WRITTEN_DECIMALS decimals."""
    if isinstance(value, float):
        return round(value, WRITTEN_DECIMALS) + 0.0
    if isinstance(value, list):
        return [rounded(item) for item in value]
    return {key: rounded(item) for key, item in value.items()} if isinstance(value, dict) else value


def one_shape(where: str, entry: dict[str, Any], folder: Path) -> tuple[tuple[Shape, ...], tuple[str, ...]]:
    """The one shape of an entry such as {box: {...}}, as a tuple, and notes. Raises InputError."""
    try:
        scene, notes = read_scene([entry], folder, field=where)
    except InputError as error:
        raise InputError(str(error).replace(f"{where}[0]", where, 1)) from None
    return scene.shapes, notes


def _text(where: str, value: object) -> str:
    if not isinstance(value, str) or not value:
        raise InputError(f"{where} is {shown(value)}; it must be a name")
    return value


def _names(where: str, value: object) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise InputError(f"{where} is {shown(value)}; it must be a list of link names")
    return tuple(value)


def read_payload(data: object) -> Payload:
    """The payload of {mass: 3.0, com: [0, 0, 0.1], link: panda_hand, moments: [...]}.

    All fields but the mass are optional. Raises InputError for anything else.
    """
    values = check_fields("payload", data, ("mass",), ("com", "link", "moments"))
    return Payload(**values)  # type: ignore[arg-type]


def payload_entry(payload: Payload) -> dict[str, object]:
    """The field of a payload, as `read_payload` reads it."""
    data: dict[str, object] = {"mass": payload.mass, "com": payload.com.tolist()}
    if payload.link is not None:
        data["link"] = payload.link
    if payload.moments.any():
        data["moments"] = payload.moments.tolist()
    return data
