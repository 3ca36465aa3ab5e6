"""Paths and trajectories in requests, and validation reports in answers."""

from dataclasses import asdict
from typing import Any

from numpy import ndarray

from robotdiffuse.core.bounds import MAX_COORDINATE, MAX_RATE, form, numbers, within
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.types import ROWS, Path, Trajectory
from robotdiffuse.scenes.files import check_fields
from robotdiffuse.validation.report import Report

MOTIONS = ("path", "trajectory")


def read_motion(name: str, data: object) -> Path | Trajectory:
    """The motion in a request: `name` is path (joint_names, positions) or trajectory (also times, velocities
    and accelerations).

    Raises InputError, naming the field, for anything else. The validator checks that times increase.
    """
    rows = ROWS if name == "trajectory" else ("positions",)
    timed = ("times",) if name == "trajectory" else ()
    values = check_fields(name, data, ("joint_names", *timed, *rows))
    names = values["joint_names"]
    if not isinstance(names, list) or not all(isinstance(joint, str) for joint in names):
        raise InputError(f"{name}.joint_names is {shown(names)}; it must be a list of names")
    arrays = [_rows(f"{name}.{what}", values[what], len(names)) for what in rows]
    if name == "path":
        return Path(tuple(names), arrays[0])
    times = _array("trajectory.times", values["times"], 1, MAX_RATE)
    if len(times) != len(arrays[0]):
        raise InputError(f"trajectory.times has {len(times)} values; positions has {len(arrays[0])} rows")
    return Trajectory(tuple(names), times, *arrays)


def _rows(where: str, value: object, columns: int) -> ndarray:
    array = _array(where, value, 2, MAX_COORDINATE if where.endswith("positions") else MAX_RATE)
    if array.shape[1] != columns:
        raise InputError(f"{where} is {form(array)}; it must have a column for each of {columns} joints")
    return array


def _array(where: str, value: object, dimensions: int, most: float) -> ndarray:
    array = numbers(value)
    if array is None or array.ndim != dimensions or len(array) == 0:
        wanted = "rows of numbers" if dimensions == 2 else "a list of numbers"
        raise InputError(f"{where} is {form(array)}; it must be {wanted}")
    if not within(array, most):
        raise InputError(f"{where} holds numbers that are not finite, or not within ±{most:g}")
    return array


def report_record(report: Report) -> dict[str, Any]:
    """A validation report as JSON values."""
    return {
        "valid": report.valid,
        "min_clearance": report.min_clearance,
        "scene_clearance": report.scene_clearance,
        "self_clearance": report.self_clearance,
        "violation": None if report.violation is None else asdict(report.violation),
    }
