"""Checks of the joint names and arrays of motions that files and requests give."""

from collections.abc import Mapping

import numpy as np
from numpy import ndarray

from robotdiffuse.core.bounds import MAX_COORDINATE, MAX_DURATION, MAX_RATE, numbers, rows
from robotdiffuse.core.errors import InputError, distinct, joined, repeated, shown

RATES = ("velocities", "accelerations")


def check_motion_arrays(
    joint_names: object, arrays: Mapping[str, object], where: str = ""
) -> tuple[tuple[str, ...], dict[str, ndarray]]:
    """The joint names and the arrays of a motion, as a tuple and as float64 arrays of equal length.

    `arrays` has the positions first, under any name, and may have `times`, `velocities` and `accelerations`.
    `where` precedes the names of fields in messages, e.g. "trajectory.". Raises InputError, naming the field,
    for missing or repeated joint names, no rows, wrong shapes, and numbers that are not finite or too large.
    Times may begin anywhere and need not increase; see `check_increasing`.
    """
    names = joint_names
    if not isinstance(names, list | tuple) or not names or not all(isinstance(n, str) and n for n in names):
        raise InputError(f"{where}joint_names is {shown(names)}; it must be a list of names, not empty")
    twice = repeated(names)
    if twice:
        raise InputError(f"{where}joint_names has {joined(twice)} more than once")
    checked: dict[str, ndarray] = {}
    count = None
    for name, value in arrays.items():
        if name == "times":
            checked[name] = _times(where + name, value, count)
        else:
            most = MAX_RATE if name in RATES else MAX_COORDINATE
            checked[name] = rows(where + name, value, count, len(names), most, ", a column for each joint")
        count = len(checked[name])
    return tuple(names), checked


def check_increasing(times: ndarray) -> None:
    """Raise InputError if finite times do not strictly increase."""
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if len(backwards):
        i = int(backwards[0])
        time, following = distinct(times[i], times[i + 1])
        raise InputError(f"times do not increase: {time} s in row {i}, {following} s in row {i + 1}")


def _times(name: str, value: object, count: int | None) -> ndarray:
    times = numbers(value)
    if times is None or times.shape != (count,):
        raise InputError(f"{name} is {shown(value)}; it must be {count} finite numbers, one for each row")
    if not np.isfinite(times).all():
        row = int(np.flatnonzero(~np.isfinite(times))[0])
        raise InputError(f"{name}[{row}] is {times[row]}; it must be a finite number")
    with np.errstate(over="ignore"):
        span = float(np.ptp(times))
    if not span <= MAX_DURATION:
        duration, limit = distinct(span, MAX_DURATION)
        raise InputError(f"{name} span {duration} s; a motion must not last longer than {limit} s")
    return times
