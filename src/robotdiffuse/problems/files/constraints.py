"""Reads and writes path constraints of problem files.

constraints:
  - axis_cone: {frame: panda_hand, axis: [0, 0, 1], direction: [0, 0, -1], angle: 0.1745}
  - position_box: {frame: panda_hand, low: [0.2, -0.5, 0.1], high: [0.7, 0.5, 0.9], xyz: ..., wxyz: ...}
  - on_plane: {frame: panda_hand, point: [0, 0, 0.4], normal: [0, 0, 1], tolerance: 0.002}
  - on_line: {frame: panda_hand, point: [0.5, 0, 0.4], direction: [0, 1, 0], tolerance: 0.002}
  - cartesian_line: {frame: panda_hand, tolerance: 0.001, angle: 0.05, speed: 0.1}
"""

from dataclasses import MISSING, fields
from typing import Any

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.core.transforms import pose_entry
from robotdiffuse.problems.constraints import CONSTRAINTS, Constraint, PositionBox
from robotdiffuse.problems.files.robot_setup import pose_of
from robotdiffuse.scenes.files import check_fields

POSE_FIELDS = ("xyz", "wxyz")


def read_constraints(data: object) -> tuple[Constraint, ...]:
    """The constraints of a problem file. Raises InputError that names the field."""
    if not isinstance(data, list):
        raise InputError(f"constraints is {shown(data)}; it must be a list of constraints")
    return tuple(_constraint(f"constraints[{i}]", entry) for i, entry in enumerate(data))


def constraint_entry(constraint: Constraint) -> dict[str, Any]:
    """The entry of a constraint, as `read_constraints` reads it."""
    values: dict[str, Any] = {}
    for field in fields(constraint):
        value = getattr(constraint, field.name)
        if field.name != "T_base_box":
            values[field.name] = value.tolist() if isinstance(value, ndarray) else value
        elif not np.array_equal(value, np.eye(4)):
            values |= pose_entry(value)
    return {constraint.kind: values}


def _constraint(where: str, entry: object) -> Constraint:
    if not isinstance(entry, dict) or len(entry) != 1:
        raise InputError(
            f"{where} is {shown(entry)}; it must be one constraint, e.g. {{axis_cone: {{...}}}}; known: "
            f"{', '.join(CONSTRAINTS)}"
        )
    [(name, given)] = entry.items()
    if name not in CONSTRAINTS:
        raise unknown_name(f"constraint in {where}:", name, CONSTRAINTS)
    kind, where = CONSTRAINTS[name], f"{where}.{name}"
    names = [field.name for field in fields(kind) if field.name != "T_base_box"]
    required = [field.name for field in fields(kind) if field.default is MISSING]
    optional = [n for n in names if n not in required] + [*(POSE_FIELDS if kind is PositionBox else ())]
    values = dict(check_fields(where, given, required, optional))
    posed = {key: values.pop(key) for key in POSE_FIELDS if key in values and kind is PositionBox}
    if posed:
        values["T_base_box"] = pose_of(where, posed)
    try:
        return kind(**values)
    except InputError as error:
        raise InputError(f"{where.removesuffix(name)}{error}") from None
