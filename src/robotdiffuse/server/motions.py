"""Paths and trajectories in requests, and validation reports in answers."""

from dataclasses import asdict
from typing import Any

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import RATES, Path, Trajectory, check_motion_arrays
from robotdiffuse.scenes.files import check_fields
from robotdiffuse.server.settings import MAX_ROWS
from robotdiffuse.validation.report import Report

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


def report_record(report: Report) -> dict[str, Any]:
    """A validation report as JSON values."""
    return {
        "valid": report.valid,
        "min_clearance": report.min_clearance,
        "scene_clearance": report.scene_clearance,
        "self_clearance": report.self_clearance,
        "violation": None if report.violation is None else asdict(report.violation),
    }
