"""Reads motions from CSV: a column for time and for each joint."""

import csv
from pathlib import Path

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.input_files import read_text
from robotdiffuse.core.types import FORMULA
from robotdiffuse.interop.recorded_motion import RecordedMotion, checked_motion

TIMES = ("time", "t", "time_from_start", "timestamp")
KINDS = {"position": "positions", "velocity": "velocities", "acceleration": "accelerations"}


def read(file: Path, topic: str | None = None) -> RecordedMotion:
    """Read a motion in the columns of `Trajectory.save`: time, then NAME or NAME_position for each joint, and
    optionally NAME_velocity and NAME_acceleration. Without time, the rows are waypoints."""
    try:
        return _read(read_text(file))
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(file)) else f"{file}: {text}") from None


def _read(text: str) -> RecordedMotion:
    try:
        reader = csv.reader(text.splitlines())
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"it is not valid CSV: {error}") from None
    if not rows:
        raise InputError("it is empty; it must have a header and rows of numbers")
    header = [cell.strip() for cell in rows[0][1]]
    header = [cell[1:] if cell.startswith("'") and cell[1:].startswith(FORMULA) else cell for cell in header]
    if len(rows) == 1:
        raise InputError("it has a header and no rows")
    columns: list[list[float]] = [[] for _ in header]
    for number, row in rows[1:]:
        if len(row) != len(header):
            raise InputError(f"line {number} has {len(row)} cells; the header has {len(header)}")
        for name, column, cell in zip(header, columns, row, strict=True):
            try:
                column.append(float(cell))
            except ValueError:
                raise InputError(f"line {number}: {name} is {shown(cell)}; it must be a number") from None
    times: list[float] | None = None
    found: dict[str, dict[str, list[float]]] = {what: {} for what in KINDS.values()}
    for name, column in zip(header, columns, strict=True):
        if name.lower() in TIMES and times is None:
            times = column
            continue
        joint, _, kind = name.rpartition("_")
        what = KINDS.get(kind, "positions")
        joint = joint if kind in KINDS else name
        if joint in found[what]:
            raise InputError(f"the header has {shown(name)} more than once")
        found[what][joint] = column
    names = list(found["positions"])
    for what in ("velocities", "accelerations"):
        if found[what] and sorted(found[what]) != sorted(names):
            raise InputError(f"the header has {what} of other joints than positions")
    table = {
        what: [list(r) for r in zip(*(c[n] for n in names), strict=True)] if c else None
        for what, c in found.items()
    }
    return checked_motion(names, table["positions"], times, table["velocities"], table["accelerations"])
