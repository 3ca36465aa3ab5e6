"""PlanResult, the answer of a planner, and the result file format."""

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from typing import Any

from robotdiffuse.core.bounds import MAX_RATE, rows
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.input_files import read_json
from robotdiffuse.core.motion_arrays import RATES, check_increasing, check_motion_arrays
from robotdiffuse.core.output_files import check_output, write_atomically
from robotdiffuse.core.types import Path, Status, Trajectory, Tree

PROBLEM_ENDINGS = (".yaml", ".yml", ".jsonl")
"""Endings of problem files that no result has."""
NO_PROBLEM = "without its problem"
"""How the note begins that says why a result was saved without its problem."""
REQUIRED = ("status", "reason", "planner", "robot", "joint_names", "planning_time", "verified", "seed")


@dataclass(frozen=True, eq=False)
class PlanResult:
    """The answer of a planner. `path` is set if and only if `status` is SOLVED, and then it passed
    `verify`.

    What a result without a motion lacks is None; to type checkers it may be anything, so that code for
    solved results needs no assertions.
    """

    status: Status
    reason: str
    """A sentence to act on; for SOLVED, where the solution came from."""
    planner: str
    robot: str
    planning_time: float
    """Wall time of plan() [s], including verification, without time parameterization."""
    seed: int
    stage: str = ""
    """The part of the planner that produced the path, e.g. 'aorrtc', 'network', 'smooth_noise'."""
    path: Path | Any = None
    trajectory: Trajectory | Any = None
    min_clearance: float | Any = None
    """Lower bound on all distances along the motion [m]: the smaller of the two below."""
    scene_clearance: float | Any = None
    """Lower bound on the distance to obstacles [m]."""
    self_clearance: float | Any = None
    """Lower bound on the distance between links [m]."""
    notes: tuple[str, ...] = field(default=())
    """Input that was changed or ignored, e.g. a start clamped to a limit."""
    goal_index: int | None = None
    """Which goal of an `AnyGoal`, or which row of several goal configurations, the motion ends at, from 0 on;
    0 for a single goal, None without a motion."""
    progress: tuple[tuple[float, float], ...] = ()
    """Time [s since the call] and joint-space length [rad] of each shorter path; the last pair is the
    returned path."""
    refused: str = ""
    """`Violation.kind` of the last path that the validator rejected; "" if it rejected none."""
    assumption: str = ""
    """Problems with views: the assumption about unknown space that the motion was planned under, e.g. "points
    padded by 9 cm"; "as seen" assumes no obstacles there. "" without views."""
    confidence: float | None = None
    """Problems with views: probability that the motion is free of obstacles in unknown space. `verified`
    covers observed obstacles only."""
    swept_probability: float | None = None
    """Sum of the predicted occupancy probabilities of all unknown voxels that the motion sweeps; None without
    the predicted policy for unknown space."""
    unknown_region: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Lower and upper corner, in the base frame [m], of a box around the crossed unknown space that is most
    likely occupied; None if the motion crosses none."""
    corner_deviations: tuple[float, ...] | None = field(default=None, repr=False)
    """How far the motion may leave each waypoint of the path [rad, joint-space L2]; None: the default of
    timing. Files do not hold it."""
    trees: tuple[Tree, ...] = field(default=(), repr=False)
    """Search trees from the start and from the goals, when the shortest path was found or time ran out. Only
    if the planner's setting `keep_trees` is true; files do not hold them."""
    problem: Any = field(default=None, repr=False)
    """The `Problem`, for files and `rd.show`; None in results read from files."""

    def __repr__(self) -> str:
        planned = f"{self.planner} in {1e3 * self.planning_time:.3g} ms"
        if self.path is None:
            return f"PlanResult({self.status.value}, {planned}: {self.reason})"
        notes = f", {len(self.notes)} notes" if self.notes else ""
        return f"PlanResult({self.status.value}, {planned}: {self.path!r}, {self.trajectory!r}{notes})"

    @property
    def solved(self) -> bool:
        return self.status is Status.SOLVED

    @property
    def path_length(self) -> float | Any:
        return None if self.path is None else self.path.length

    @property
    def duration(self) -> float | Any:
        """Duration of the motion [s]; None without a trajectory."""
        return None if self.trajectory is None else self.trajectory.duration

    @property
    def stops(self) -> int | Any:
        """Number of times that the arm rests between start and goal; None without a trajectory."""
        return None if self.trajectory is None else len(self.trajectory.stops)

    def save(self, file: str | FilePath, problem: dict[str, Any] | None = None) -> None:
        """Write .json (everything, with the problem as in a problem file) or .csv (the trajectory alone).

        problem: None: that of the result. A robot that is neither bundled nor read from a file cannot be
        named; then the file holds no problem, and a note says so.

        Raises InputError for another ending, a file that cannot be written, or .csv without a trajectory.
        """
        path = check_output(file, (".json", ".csv"))
        if path.suffix.lower() == ".json":
            notes = self.notes
            if problem is None and self.problem is not None:
                try:
                    problem = self.problem.record()
                except InputError as error:
                    notes = (*notes, f"{NO_PROBLEM}: {error}")
            record = replace(self, notes=notes).record(problem)
            write_atomically(path, json.dumps(record, allow_nan=False) + "\n")
        elif self.trajectory is None:
            raise InputError(f"{path}: there is no trajectory to write ({self.status.value}); use .json")
        else:
            self.trajectory.save(path)

    def record(self, problem: dict[str, Any] | None = None) -> dict[str, Any]:
        """The content of a result file as JSON values; `problem` as in a problem file."""
        return _record(self, problem)


@dataclass(frozen=True, eq=False)
class ResultFile:
    """Content of a result file."""

    result: PlanResult
    problem: dict[str, Any] | None
    """The problem as in a problem file, if it was saved too."""


def load_result(file: str | FilePath) -> ResultFile:
    """Read and check a result file (.json).

    Raises InputError for a file that cannot be read and for fields that are missing, of the wrong shape or
    not finite.
    """
    planned = f"it is a problem; `robotdiffuse plan {file} --out result.json` makes a result of it"
    if FilePath(str(file)).suffix.lower() in PROBLEM_ENDINGS:
        raise InputError(f"{file} is not a result file: {planned}")
    record = read_json(file)
    if not isinstance(record, dict):
        raise InputError(f"{file} is not a result file: it must hold one JSON object")
    if "scene" in record and "status" not in record:
        raise InputError(f"{file} is not a result file: {planned}")
    missing = [name for name in REQUIRED if name not in record]
    if missing:
        raise InputError(f"{file} is not a result file: {', '.join(missing)} missing")
    try:
        return ResultFile(_result(record), _optional(record, "problem", dict))
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _record(result: PlanResult, problem: dict[str, Any] | None) -> dict[str, Any]:
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
        "duration": result.duration,
        "stops": result.stops,
        "min_clearance": result.min_clearance,
        "scene_clearance": result.scene_clearance,
        "self_clearance": result.self_clearance,
        "notes": list(result.notes),
        "goal_index": result.goal_index,
        "progress": [list(found) for found in result.progress],
        "refused": result.refused,
        "assumption": result.assumption,
        "confidence": result.confidence,
        "swept_probability": result.swept_probability,
        "unknown_region": None
        if result.unknown_region is None
        else [list(at) for at in result.unknown_region],
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
        record |= result.trajectory.record()
    return record if problem is None else record | {"problem": problem}


def _result(record: dict[str, Any]) -> PlanResult:
    known = {status.value: status for status in Status}
    if not isinstance(record["status"], str) or record["status"] not in known:
        raise InputError(f"status is {shown(record['status'])}; known: {', '.join(known)}")
    status = known[record["status"]]
    solved = status is Status.SOLVED
    if record["verified"] is not solved:
        raise InputError(f"verified is {shown(record['verified'])}, but status is {shown(status.value)}")
    path = _path(record) if solved else None
    trajectory = _trajectory(record) if solved and record.get("times") else None
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
        notes=_texts(record, "notes") if "notes" in record else (),
        goal_index=_index_or_none(record, "goal_index"),
        progress=_progress(record.get("progress")),
        refused=_text(record, "refused") if "refused" in record else "",
        assumption=_text(record, "assumption") if "assumption" in record else "",
        confidence=_number_or_none(record, "confidence"),
        swept_probability=_number_or_none(record, "swept_probability"),
        unknown_region=_box(record.get("unknown_region")),
    )


def _box(value: object) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    if value is None:
        return None
    low, high = rows("unknown_region", value, 2, 3).tolist()
    return tuple(low), tuple(high)


def _progress(value: object) -> tuple[tuple[float, float], ...]:
    if not value:
        return ()
    return tuple((at, length) for at, length in rows("progress", value, None, 2, MAX_RATE).tolist())


def _path(record: dict[str, Any]) -> Path:
    names, arrays = check_motion_arrays(record["joint_names"], {"waypoints": record.get("waypoints")})
    return Path(names, arrays["waypoints"])


def _trajectory(record: dict[str, Any]) -> Trajectory:
    fields = {name: record.get(name) for name in ("positions", "times", *RATES)}
    names, arrays = check_motion_arrays(record["joint_names"], fields)
    if arrays["times"][0] != 0:
        raise InputError(f"times begin at {arrays['times'][0]:g} s; they must begin at 0")
    check_increasing(arrays["times"])
    return Trajectory(names, **arrays)


def _optional(record: dict[str, Any], name: str, kind: type) -> Any:
    value = record.get(name)
    if value is not None and not isinstance(value, kind):
        raise InputError(f"{name} is a {type(value).__name__}; it must be an object")
    return value


def _text(record: dict[str, Any], name: str) -> str:
    if not isinstance(record[name], str):
        raise InputError(f"{name} is {shown(record[name])}; it must be a string")
    return record[name]


def _texts(record: dict[str, Any], name: str) -> tuple[str, ...]:
    value = record[name]
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise InputError(f"{name} is {shown(value)}; it must be a list of strings")
    return tuple(value)


def _number(record: dict[str, Any], name: str) -> float:
    value = record[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} is {shown(value)}; it must be a finite number")
    return float(value)


def _number_or_none(record: dict[str, Any], name: str) -> float | None:
    return None if record.get(name) is None else _number(record, name)


def _index_or_none(record: dict[str, Any], name: str) -> int | None:
    value = record.get(name)
    if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 0):
        raise InputError(f"{name} is {shown(value)}; it must be a whole number from 0 on")
    return value
