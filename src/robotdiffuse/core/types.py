"""Path, Trajectory, search Tree, and the Status of a planning call."""

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

from robotdiffuse.core.bounds import Value
from robotdiffuse.core.output_files import check_output, write_atomically

ROWS = ("positions", "velocities", "accelerations")
"""Arrays of a trajectory with a row for each time."""


class Status(Enum):
    """How a planning call ended."""

    SOLVED = "solved"
    TIMEOUT = "timeout"
    """No path was found within the time limit."""
    NO_PATH = "no_path"
    """The search ended before the time limit without a path."""
    INVALID_START = "invalid_start"
    """The start is out of limits, in collision or too close to it."""
    INVALID_GOAL = "invalid_goal"
    """Every goal is out of limits, in collision or too close to it."""
    UNREACHABLE_GOAL = "unreachable_goal"
    """Inverse kinematics found no configuration for the goal pose."""
    ERROR = "error"
    """`plan_many` only: planning this problem raised an error, or killed its process."""


FIRST, CONVERGED, TIME_LIMIT = UNTIL = ("first", "converged", "time_limit")
"""When planning ends: at the first verified motion, when paths stop getting shorter, or at the time limit."""


@dataclass(frozen=True, eq=False)
class Path(Value):
    """Waypoints joined by straight segments in joint space."""

    joint_names: tuple[str, ...]
    positions: Float[ndarray, "n dof"]
    """[rad], [m] for prismatic joints."""

    @property
    def length(self) -> float:
        """Sum of the Euclidean lengths of the segments in joint space [rad]."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())


class Tree(NamedTuple):
    """A search tree grown from the start or the goals.

    The straight line in joint space from each node to its parent is free of collision.
    """

    nodes: Float[ndarray, "n dof"]
    """[rad], [m] for prismatic joints; roots first."""
    parents: Int[ndarray, "n"]
    """Row of each node's parent, which precedes its own; -1 for roots."""


@dataclass(frozen=True, eq=False)
class Trajectory(Value):
    """Positions, velocities and accelerations over time."""

    joint_names: tuple[str, ...]
    times: Float[ndarray, "n"]
    """[s], starting at 0, strictly increasing."""
    positions: Float[ndarray, "n dof"]
    velocities: Float[ndarray, "n dof"]
    accelerations: Float[ndarray, "n dof"]

    @property
    def duration(self) -> float:
        """Time of the last row [s]."""
        return float(self.times[-1])

    def save(self, file: str | FilePath) -> None:
        """Write .json or .csv, by the file's ending.

        The CSV header is time, then <joint>_position, <joint>_velocity and <joint>_acceleration. Raises
        InputError for another ending or a file that cannot be written.
        """
        path = check_output(file, (".json", ".csv"))
        if path.suffix.lower() == ".json":
            write_atomically(path, json.dumps(self.record(), allow_nan=False) + "\n")
        else:
            write_atomically(path, self._csv())

    def record(self) -> dict[str, Any]:
        """The trajectory as JSON values."""
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
