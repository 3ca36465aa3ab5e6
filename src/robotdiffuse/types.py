"""What a planner returns: Path, Trajectory, Status, PlanResult."""

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from jaxtyping import Float
from numpy import ndarray


class Status(Enum):
    """Why a call to a planner ended."""

    SOLVED = "solved"
    TIMEOUT = "timeout"
    """No path was found within the time limit."""
    NO_PATH = "no_path"
    """The search ended before that without a path."""
    INVALID_START = "invalid_start"
    """The start is out of limits or in collision."""
    INVALID_GOAL = "invalid_goal"
    """Every goal is out of limits or in collision."""
    UNREACHABLE_GOAL = "unreachable_goal"
    """Inverse kinematics found no configuration for the goal pose."""


@dataclass(frozen=True, eq=False)
class Path:
    """Waypoints joined by straight lines in joint space."""

    joint_names: tuple[str, ...]
    positions: Float[ndarray, "n dof"]
    """[rad], [m] for prismatic joints."""

    @property
    def length(self) -> float:
        """Sum of the Euclidean lengths of the segments in joint space [rad]."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A path with a time at each row."""

    joint_names: tuple[str, ...]
    times: Float[ndarray, "n"]
    """[s], starting at 0, strictly increasing."""
    positions: Float[ndarray, "n dof"]
    velocities: Float[ndarray, "n dof"]
    accelerations: Float[ndarray, "n dof"]

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self.times[-1])

    def save(self, file: str) -> None:
        """Write .json or .csv, by the ending; atomically."""
        from robotdiffuse.paths.export import save_trajectory

        save_trajectory(self, file)


@dataclass(frozen=True, eq=False)
class PlanResult:
    """The answer of a planner. `path` is set if and only if `status` is SOLVED; then it passed `verify`."""

    status: Status
    reason: str
    """A sentence that a person can act on; for SOLVED: what the solution came from."""
    planner: str
    robot: str
    planning_time: float
    """Wall time of plan() [s], with verification and without the timing of the trajectory."""
    seed: int
    stage: str = ""
    """The part of the planner that produced the path, e.g. 'network', 'refinement', 'rrt_connect'."""
    path: Path | None = None
    trajectory: Trajectory | None = None
    min_clearance: float | None = None
    """A lower bound of all distances along the motion [m], the smaller of ..."""
    scene_clearance: float | None = None
    """... that of the distances to obstacles, and ..."""
    self_clearance: float | None = None
    """... that of those between links. Results of earlier versions lack the two."""
    notes: tuple[str, ...] = field(default=())
    """What was changed or ignored in the input, e.g. a start clamped to a limit."""
    progress: tuple[tuple[float, float], ...] = ()
    """When each shorter path was found [s since the call], and its joint-space length [rad]; the last pair is
    the returned path's."""
    refused: str = ""
    """What was wrong with the last path that the judge refused, a `verify.Violation.kind`; "" if none was."""

    @property
    def solved(self) -> bool:
        return self.status is Status.SOLVED

    @property
    def path_length(self) -> float | None:
        return None if self.path is None else self.path.length

    def save(self, file: str) -> None:
        """Write the result as .json (all of it) or .csv (the trajectory alone); atomically."""
        from robotdiffuse.paths.export import save_result

        save_result(self, file)
