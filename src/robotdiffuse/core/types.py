"""What motions are: Path and Trajectory; and Status, why a planner ended."""

import csv
import io
import json
from dataclasses import dataclass
from enum import Enum
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.output_files import check_output, write_atomically

ROWS = ("positions", "velocities", "accelerations")
"""What a trajectory has for each time."""


class Status(Enum):
    """Why a call to a planner ended."""

    SOLVED = "solved"
    TIMEOUT = "timeout"
    """No path was found within the time limit."""
    NO_PATH = "no_path"
    """The search ended before that without a path."""
    INVALID_START = "invalid_start"
    """The start is out of limits, in collision or too close to it."""
    INVALID_GOAL = "invalid_goal"
    """Every goal is out of limits, in collision or too close to it."""
    UNREACHABLE_GOAL = "unreachable_goal"
    """Inverse kinematics found no configuration for the goal pose."""
    ERROR = "error"
    """Of many problems: this one raised an error, or its process died of it."""


FIRST, CONVERGED, TIME_LIMIT = UNTIL = ("first", "converged", "time_limit")
"""When planning ends: with the first verified motion; when more time stops paying; when time runs out."""


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


class Tree(NamedTuple):
    """What a search has grown from one end; from a node to its parent the straight line in joint space is
    free."""

    nodes: Float[ndarray, "n dof"]
    """[rad], [m] for prismatic joints; the roots first."""
    parents: Int[ndarray, "n"]
    """The row of each node's parent, before its own; -1 for roots."""


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

    def save(self, file: str | FilePath) -> None:
        """Write .json or .csv, by the ending; the CSV header is time, then <joint>_position and so on.

        Raises InputError for another ending or a file that cannot be written.
        """
        path = check_output(file, (".json", ".csv"))
        if path.suffix.lower() == ".json":
            write_atomically(path, json.dumps(self.record(), allow_nan=False) + "\n")
        else:
            write_atomically(path, self._csv())

    def record(self) -> dict[str, Any]:
        """For JSON."""
        rows = {name: getattr(self, name).tolist() for name in ("times", *ROWS)}
        return {"joint_names": list(self.joint_names)} | rows

    def _csv(self) -> str:
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        kinds = ("position", "velocity", "acceleration")
        writer.writerow(["time", *(f"{name}_{kind}" for kind in kinds for name in self.joint_names)])
        columns = (self.times[:, None], *(getattr(self, rows) for rows in ROWS))
        writer.writerows([repr(value) for value in row] for row in np.concatenate(columns, axis=1).tolist())
        return stream.getvalue()
