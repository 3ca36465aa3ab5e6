"""PlanResult, the answer of a planner, and the result file format."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from types import NoneType
from typing import Any

from robotdiffuse.core.errors import InputError, check_type, located, shown
from robotdiffuse.core.input_files import known_ending, read_json
from robotdiffuse.core.output_files import check_output, write_atomically
from robotdiffuse.core.settings import Natural, Number, converted
from robotdiffuse.core.types import (
    RATES,
    ROWS,
    Path,
    Status,
    Trajectory,
    Tree,
    check_increasing,
    check_motion_arrays,
)

PROBLEM_ENDINGS = (".yaml", ".yml", ".jsonl")
"""Endings that problem files may have and result files never have."""
NO_PROBLEM = "without its problem"
"""Beginning of the note with the reason why a result was saved without its problem."""
REQUIRED = ("status", "reason", "planner", "robot", "joint_names", "planning_time", "verified", "seed")


@dataclass(frozen=True, eq=False)
class PlanResult:
    """The answer of a planner. `path` is set if and only if `status` is SOLVED; every such path has passed
    `verify`.

    Fields that describe a motion are None if there is none. They are annotated with Any, so that type
    checkers ask for no assertions in code for solved results.
    """

    status: Status
    """How the call ended."""
    reason: str
    """A sentence: if SOLVED, which part of the planner found the path; otherwise why there is no motion, and
    what to do."""
    planner: str
    """Name of the planner."""
    robot: str
    """Name of the robot."""
    planning_time: float
    """Wall time of plan() until the returned path is validated [s], without loading time. The path's final
    time parameterization follows and does not count, except with waypoints, camera views or moving
    obstacles."""
    seed: int
    """Seed of the random numbers."""
    stage: str = ""
    """The part of the planner that produced the path, e.g. 'aorrtc', 'straight_line', 'network'."""
    path: Path | Any = None
    """Waypoints from the start to a goal."""
    trajectory: Trajectory | Any = None
    """The timed motion along the path."""
    min_clearance: float | Any = None
    """Lower bound on all distances along the motion [m]: the smaller of `scene_clearance` and
    `self_clearance`."""
    scene_clearance: float | Any = None
    """Lower bound on the distance to obstacles [m]."""
    self_clearance: float | Any = None
    """Lower bound on the distance between links [m]."""
    notes: tuple[str, ...] = field(default=())
    """Input that was changed or ignored, e.g. a start clamped to a limit."""
    goal_index: int | None = None
    """Index from 0 of the goal where the motion ends, among the goals of an `AnyGoal` or the rows of several
    goal configurations; 0 for a single goal, None without a motion."""
    progress: tuple[tuple[float, float], ...] = ()
    """Time [s since the call] and joint-space length [rad] of each path that was shorter than all before; the
    last pair is the returned path."""
    refused: str = ""
    """`Violation.kind` of the last path that the validator rejected; "" if it rejected none."""
    assumption: str = ""
    """Problems with camera views: the assumption about unknown space under which the motion was planned, e.g.
    "points padded by 9 cm". "as seen" assumes that unknown space has no obstacles. "" without views."""
    confidence: float | None = None
    """Problems with camera views: probability that the motion hits no obstacle in unknown space. `verify`
    checks observed obstacles only."""
    swept_probability: float | None = None
    """Sum of the predicted occupancy probabilities of all unknown voxels that the motion sweeps; None without
    the predicted policy for unknown space."""
    unknown_region: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Lower and upper corner, in the base frame [m], of a box around the part of the unknown space
    that the motion crosses with the largest summed probability to be occupied; None if it crosses none."""
    fraction: float | None = None
    """Problems with a Cartesian line: the fraction of the line that the arm can follow from the start, 1 if
    there is a motion. If it is below 1, `reason` says what stops the arm."""
    corner_deviations: tuple[float, ...] = field(default=(), repr=False)
    """For each waypoint of the path, the largest distance at which the motion may pass it, rounding the
    corner [rad, joint-space L2]. Empty without a path, and in results that were read from a file."""
    trees: tuple[Tree, ...] = field(default=(), repr=False)
    """Search trees from the start and from the goals, when the shortest path was found or time ran out. Empty
    unless the planner's setting `keep_trees` is true; result files omit them."""
    problem: Any = field(default=None, repr=False)
    """The `Problem`, which `save` and `rd.show` use; None in results read from files."""

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
        """Write the result.

        Args:
            file: A .json file for the result and its problem, or a .csv file for the trajectory alone.
            problem: The content of a problem file; None: the result's own problem. If its robot is neither
                bundled nor read from a file, the file holds no problem, and a note says so.

        Raises:
            InputError: For another ending, a file that cannot be written, or .csv without a trajectory.
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
        """Convert the result to JSON values.

        Args:
            problem: The content of a problem file, to include.

        Returns:
            The content of a result file.
        """
        path = self.path
        record: dict[str, Any] = {"status": self.status.value}
        record |= {name: getattr(self, name) for name in RECORDED}
        record |= {
            "verified": self.solved,
            "path_length": self.path_length,
            "duration": self.duration,
            "stops": self.stops,
            "joint_names": [] if path is None else list(path.joint_names),
            "waypoints": None if path is None else path.positions.tolist(),
            "times": [],
            **{name: [] for name in ROWS},
        }
        if self.trajectory is not None:
            record |= self.trajectory.record()
        return record if problem is None else record | {"problem": problem}


@dataclass(frozen=True, eq=False)
class ResultFile:
    """Content of a result file."""

    result: PlanResult
    problem: dict[str, Any] | None
    """The problem as in a problem file, if it was saved too."""


def load_result(file: str | FilePath) -> ResultFile:
    """Read and check a result file.

    Args:
        file: A .json file that `PlanResult.save` or `robotdiffuse plan --out` wrote.

    Returns:
        The result, and the content of its problem file if that was saved too.

    Raises:
        InputError: For a file that cannot be read, and for fields that are missing, of the wrong shape or not
            finite.

    Examples:
        >>> problem = rd.Problem(rd.load_robot("panda"), rd.Scene(), "ready", "extended")
        >>> rd.plan(problem, until="first").save("result.json")
        >>> rd.load_result("result.json").result.status.value
        'solved'
    """
    planned = f"it is a problem; `robotdiffuse plan {file} --out result.json` makes a result of it"
    if FilePath(str(file)).suffix.lower() in PROBLEM_ENDINGS:
        raise InputError(f"{file} is not a result file: {planned}")
    known_ending(file, "result file", (".json",))
    record = read_json(file)
    if not isinstance(record, dict):
        raise InputError(f"{file} is not a result file: it must hold one JSON object")
    if "scene" in record and "status" not in record:
        raise InputError(f"{file} is not a result file: {planned}")
    missing = [name for name in REQUIRED if record.get(name) is None]
    if missing:
        raise InputError(f"{file} is not a result file: {', '.join(missing)} missing")
    with located(file):
        problem = record.get("problem")
        check_type("problem", problem, (dict, NoneType), "an object")
        return ResultFile(_result(record), problem)


Corner = tuple[Number, Number, Number]
RECORDED: dict[str, Any] = {
    "reason": str,
    "planner": str,
    "stage": str,
    "robot": str,
    "planning_time": Number,
    "seed": int,
    "min_clearance": Number,
    "scene_clearance": Number,
    "self_clearance": Number,
    "notes": tuple[str, ...],
    "goal_index": Natural,
    "progress": tuple[tuple[Number, Number], ...],
    "refused": str,
    "assumption": str,
    "confidence": Number,
    "swept_probability": Number,
    "unknown_region": tuple[Corner, Corner],
    "fraction": Number,
}
"""Fields that result files hold under the same name, in this order, with their types. A field that the result
lacks is null."""


def _result(record: dict[str, Any]) -> PlanResult:
    statuses = {status.value: status for status in Status}
    if not isinstance(record["status"], str) or record["status"] not in statuses:
        raise InputError(f"status is {shown(record['status'])}; known: {', '.join(statuses)}")
    status = statuses[record["status"]]
    solved = status is Status.SOLVED
    if record["verified"] is not solved:
        raise InputError(f"verified is {shown(record['verified'])}, but status is {shown(status.value)}")
    values = {
        name: converted(name, kind, record[name])
        for name, kind in RECORDED.items()
        if record.get(name) is not None
    }
    if solved:
        names, arrays = check_motion_arrays(record["joint_names"], {"waypoints": record.get("waypoints")})
        values["path"] = Path(names, arrays["waypoints"])
        values["trajectory"] = _trajectory(record) if record.get("times") else None
    return PlanResult(status=status, **values)


def _trajectory(record: dict[str, Any]) -> Trajectory:
    fields = {name: record.get(name) for name in ("positions", "times", *RATES)}
    names, arrays = check_motion_arrays(record["joint_names"], fields)
    if arrays["times"][0] != 0:
        raise InputError(f"times begin at {arrays['times'][0]:g} s; they must begin at 0")
    check_increasing(arrays["times"])
    return Trajectory(names, **arrays)
