"""Reads joint limits from files in the form of MoveIt's joint_limits.yaml."""

import math
from dataclasses import replace
from pathlib import Path

from robotdiffuse.core.bounds import MAX_COORDINATE, MAX_RATE, MIN_RATE
from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.core.input_files import read_yaml
from robotdiffuse.robots.joints import MOVING_KINDS, Joint
from robotdiffuse.robots.parsing.urdf import ACCELERATION_PER_VELOCITY, JERK_PER_ACCELERATION
from robotdiffuse.robots.robot import Robot

FIELDS = {
    "min_position": "lower",
    "max_position": "upper",
    "max_velocity": "velocity",
    "max_acceleration": "acceleration",
    "max_jerk": "jerk",
}
FACTORS = ("default_velocity_scaling_factor", "default_acceleration_scaling_factor")
FLAGS = (
    "has_position_limits",
    "has_velocity_limits",
    "has_acceleration_limits",
    "has_jerk_limits",
)


def read_limits(file: str | Path) -> tuple[dict[str, dict[str, float]], tuple[str, ...]]:
    """Read limits from a YAML or JSON file: values by joint and by field of `Joint`, and notes.

    The file has the form joint_limits: {JOINT: {max_velocity: 2.0}}, with the fields min_position,
    max_position, max_velocity, max_acceleration and max_jerk. A field is ignored if MoveIt's flag
    has_..._limits for it is false. Other fields of the file, such as MoveIt's default scaling factors, are
    ignored, with a note. Raises InputError that names the joint and the field.
    """
    data = read_yaml(file, "joint limits")
    joints = data.get("joint_limits") if isinstance(data, dict) else None
    if not isinstance(joints, dict):
        raise InputError(
            f"{file} has no joint_limits; it must contain joint_limits: {{JOINT: {{max_velocity: ...}}}}"
        )
    notes = tuple(
        f"{Path(file).name}: {name} {shown(value)} is ignored"
        + (
            f"; plan with {name.removeprefix('default_').removesuffix('_factor')}={value}"
            if name in FACTORS
            else ""
        )
        for name, value in data.items()
        if name != "joint_limits"
    )
    return {str(name): _fields(str(file), str(name), entry) for name, entry in joints.items()}, notes


def with_limits(robot: Robot, limits: dict[str, dict[str, float]]) -> Robot:
    """The robot with limits changed, by joint and field; InputError for an unknown joint.

    A new velocity limit also scales acceleration and jerk limits, unless these are given. A continuous joint
    with a position limit becomes revolute; a missing second limit is half a turn.
    """
    movable = {joint.name: joint for joint in robot.joints if joint.kind in MOVING_KINDS}
    for name in limits:
        if name not in movable:
            raise unknown_name("joint in joint_limits", name, movable)
    changed = [
        _changed(joint, limits[joint.name]) if joint.name in limits else joint for joint in robot.joints
    ]
    return replace(robot, joints=tuple(changed))


def _fields(file: str, joint: str, entry: object) -> dict[str, float]:
    if not isinstance(entry, dict):
        raise InputError(f"{file}: joint_limits of {joint} is {shown(entry)}; it must be a mapping")
    fields: dict[str, float] = {}
    for key, value in entry.items():
        if key in FLAGS:
            continue
        if key not in FIELDS:
            raise unknown_name(f"field of {joint} in {file}", key, FIELDS)
        kind = "position" if key.endswith("position") else key.removeprefix("max_")
        if entry.get(f"has_{kind}_limits") is False:
            continue
        most = MAX_COORDINATE if kind == "position" else MAX_RATE
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not number or abs(value) > most or (kind != "position" and value < MIN_RATE):
            rule = f"within ±{most:g}" if kind == "position" else f"from {MIN_RATE:g} to {most:g}"
            raise InputError(f"{file}: {key} of {joint} is {shown(value)}; it must be a number {rule}")
        fields[FIELDS[key]] = float(value)
    return fields


def _changed(joint: Joint, fields: dict[str, float]) -> Joint:
    if "velocity" in fields and "acceleration" not in fields:
        fields = fields | {"acceleration": ACCELERATION_PER_VELOCITY * fields["velocity"]}
    if "acceleration" in fields and "jerk" not in fields:
        fields = fields | {"jerk": JERK_PER_ACCELERATION * fields["acceleration"]}
    if joint.kind == "continuous" and {"lower", "upper"} & fields.keys():
        joint = replace(joint, kind="revolute", lower=-math.pi, upper=math.pi)
    lower = fields.get("lower", joint.lower)
    upper = fields.get("upper", joint.upper)
    if lower > upper:
        raise InputError(f"joint_limits of {joint.name}: min_position {lower} is above max_position {upper}")
    return replace(joint, **fields)
