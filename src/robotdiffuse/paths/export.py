"""Results and trajectories as files."""

import csv
import io
import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from robotdiffuse.errors import InputError
from robotdiffuse.files import write_atomically
from robotdiffuse.types import Path, PlanResult, Status, Trajectory

ROWS = ("positions", "velocities", "accelerations")
REQUIRED = ("status", "reason", "planner", "robot", "joint_names", "planning_time", "verified", "seed")


@dataclass(frozen=True, eq=False)
class ResultFile:
    """What a result file holds."""

    result: PlanResult
    problem: dict[str, Any] | None
    """The problem as in a problem file, if it was saved along."""


def check_output(file: str | FilePath, endings: tuple[str, ...]) -> FilePath:
    """The file as a path, after a check that it can be written.

    Raises InputError for an ending that is not among `endings` and for a folder that is missing or read-only.
    """
    path = FilePath(file)
    if path.suffix.lower() not in endings:
        raise InputError(f"{path}: unknown ending {path.suffix!r}; known: {', '.join(endings)}")
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
        raise InputError(f"{path} cannot be written: permission denied")
    return path


def save_trajectory(trajectory: Trajectory, file: str | FilePath) -> None:
    """Write .json or .csv, by the ending; the CSV header is time, then <joint>_position and so on.

    Raises InputError for another ending or a file that cannot be written.
    """
    path = check_output(file, tuple(TRAJECTORY_WRITERS))
    write_atomically(path, TRAJECTORY_WRITERS[path.suffix.lower()](trajectory))


def save_result(result: PlanResult, file: str | FilePath, problem: dict[str, Any] | None = None) -> None:
    """Write .json (everything, and the problem if given) or .csv (the trajectory alone).

    Raises InputError for another ending, a file that cannot be written, or .csv without a trajectory.
    """
    path = check_output(file, (".json", ".csv"))
    if path.suffix.lower() == ".json":
        write_atomically(path, _json(_result_record(result, problem)))
    elif result.trajectory is None:
        raise InputError(f"{path}: there is no trajectory to write ({result.status.value}); use .json")
    else:
        save_trajectory(result.trajectory, path)


def load_result(file: str | FilePath) -> ResultFile:
    """Read and check a result file (.json).

    Raises InputError for a file that cannot be read and for fields that are missing, misshapen or not finite.
    """
    try:
        record = json.loads(FilePath(file).read_text())
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{file} is not a JSON result file: {error}") from None
    if not isinstance(record, dict):
        raise InputError(f"{file} is not a result file: it must hold one JSON object")
    missing = [name for name in REQUIRED if name not in record]
    if missing:
        raise InputError(f"{file} is not a result file: {', '.join(missing)} missing")
    try:
        return ResultFile(_result(record), _optional(record, "problem", dict))
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _json(record: dict[str, Any]) -> str:
    return json.dumps(record, allow_nan=False) + "\n"


def _trajectory_record(trajectory: Trajectory) -> dict[str, Any]:
    return {
        "joint_names": list(trajectory.joint_names),
        "times": trajectory.times.tolist(),
        "positions": trajectory.positions.tolist(),
        "velocities": trajectory.velocities.tolist(),
        "accelerations": trajectory.accelerations.tolist(),
    }


def _trajectory_csv(trajectory: Trajectory) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    kinds = ("position", "velocity", "acceleration")
    writer.writerow(["time", *(f"{name}_{kind}" for kind in kinds for name in trajectory.joint_names)])
    columns = (trajectory.times[:, None], *(getattr(trajectory, rows) for rows in ROWS))
    writer.writerows([repr(value) for value in row] for row in np.concatenate(columns, axis=1).tolist())
    return stream.getvalue()


TRAJECTORY_WRITERS: dict[str, Callable[[Trajectory], str]] = {
    ".json": lambda trajectory: _json(_trajectory_record(trajectory)),
    ".csv": _trajectory_csv,
}


def _result_record(result: PlanResult, problem: dict[str, Any] | None) -> dict[str, Any]:
    record: dict[str, Any] = {
        "status": result.status.value,
        "reason": result.reason,
        "planner": result.planner,
        "stage": result.stage,
        "robot": result.robot,
        "planning_time": result.planning_time,
        "verified": result.solved,
        "seed": result.seed,
        "path_length": result.path_length,
        "min_clearance": result.min_clearance,
        "scene_clearance": result.scene_clearance,
        "self_clearance": result.self_clearance,
        "notes": list(result.notes),
        "joint_names": [],
        "waypoints": None if result.path is None else result.path.positions.tolist(),
        "times": [],
        "positions": [],
        "velocities": [],
        "accelerations": [],
    }
    if result.path is not None:
        record["joint_names"] = list(result.path.joint_names)
    if result.trajectory is not None:
        record |= _trajectory_record(result.trajectory)
    return record if problem is None else record | {"problem": problem}


def _result(record: dict[str, Any]) -> PlanResult:
    known = {status.value: status for status in Status}
    if record["status"] not in known:
        raise InputError(f"status is {record['status']!r}; known: {', '.join(known)}")
    status = known[record["status"]]
    names = _names(record, "joint_names")
    solved = status is Status.SOLVED
    if record["verified"] is not solved:
        raise InputError(f"verified is {record['verified']!r}, but status is {status.value!r}")
    path = Path(names, _rows(record, "waypoints", None, len(names))) if solved else None
    trajectory = _trajectory(record, names) if solved and record.get("times") else None
    return PlanResult(
        status=status,
        reason=_text(record, "reason"),
        planner=_text(record, "planner"),
        robot=_text(record, "robot"),
        planning_time=_number(record, "planning_time"),
        seed=int(_number(record, "seed")),
        stage=_text(record, "stage") if "stage" in record else "",
        path=path,
        trajectory=trajectory,
        min_clearance=_number_or_none(record, "min_clearance"),
        scene_clearance=_number_or_none(record, "scene_clearance"),
        self_clearance=_number_or_none(record, "self_clearance"),
        notes=_names(record, "notes") if "notes" in record else (),
    )


def _trajectory(record: dict[str, Any], names: tuple[str, ...]) -> Trajectory:
    times = _rows(record, "times", None, None)
    if (np.diff(times) <= 0).any() or times[0] != 0:
        raise InputError("times must start at 0 and strictly increase")
    return Trajectory(names, times, *(_rows(record, what, len(times), len(names)) for what in ROWS))


def _optional(record: dict[str, Any], name: str, kind: type) -> Any:
    value = record.get(name)
    if value is not None and not isinstance(value, kind):
        raise InputError(f"{name} is a {type(value).__name__}; it must be an object")
    return value


def _text(record: dict[str, Any], name: str) -> str:
    if not isinstance(record[name], str):
        raise InputError(f"{name} is {record[name]!r}; it must be text")
    return record[name]


def _names(record: dict[str, Any], name: str) -> tuple[str, ...]:
    value = record[name]
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise InputError(f"{name} is {value!r}; it must be a list of texts")
    return tuple(value)


def _number(record: dict[str, Any], name: str) -> float:
    value = record[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} is {value!r}; it must be a finite number")
    return float(value)


def _number_or_none(record: dict[str, Any], name: str) -> float | None:
    return None if record.get(name) is None else _number(record, name)


def _rows(record: dict[str, Any], name: str, rows: int | None, columns: int | None) -> np.ndarray:
    """An array of finite numbers: a vector if `columns` is None; any number of rows if `rows` is None."""
    try:
        array = np.asarray(record.get(name), dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} must be {'a list' if columns is None else 'rows'} of numbers") from None
    shape = "x".join(map(str, array.shape))
    wanted = f"{rows or 'n'}" + ("" if columns is None else f"x{columns}")
    if array.ndim != (1 if columns is None else 2) or len(array) == 0:
        raise InputError(f"{name} has shape {shape or 'none'}; it must be {wanted}")
    if (rows is not None and len(array) != rows) or (columns is not None and array.shape[1] != columns):
        raise InputError(f"{name} has shape {shape}; it must be {wanted}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} holds numbers that are not finite")
    return array
