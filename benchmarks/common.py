"""Code that the benchmarks share: header of a report, tables, problems, processor time, checks on meshes."""

import argparse
import os
import platform
import time
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from rich.console import Console
from rich.progress import track

from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.tables import Column, Rows, Table, show
from robotdiffuse.core.types import UNTIL, Trajectory
from robotdiffuse.evaluation.report import processor, versions
from robotdiffuse.evaluation.runs import hard_cases
from robotdiffuse.problems.files import Case
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.simulation.validator import PyBulletOracle
from robotdiffuse.trajectories.speed_limits import jerk_limits

Item = TypeVar("Item")
WIDTH = 120
"""Width of printed tables [characters]."""
FIRST, CONVERGED, TIME_LIMIT = UNTIL
"""Values of `until`: stop at the first path, when more time hardly improves it, or at the time limit."""
CHECK_STEP = 1e-4
"""Time between the checks of a motion's limits [s]."""
ORACLE_TOLERANCE = 0.001
"""PyBullet's own error in distances [m]."""


def header(*packages: str) -> str:
    """Date, processor, load and versions: the first line of a report."""
    names = ", ".join(f"{name} {number}" for name, number in versions(packages).items())
    machine = f"{processor()}, {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f} before"
    return f"{date.today()}; {machine}; Python {platform.python_version()}, {names}"


def print_table(title: str, columns: Sequence[Column | str], rows: Rows, notes: Sequence[str] = ()) -> None:
    """Print a table. All columns but the first are aligned to the right."""
    show(Table.of(title, columns, rows, notes), width=WIDTH)


def progress(items: Sequence[Item], title: str) -> Iterable[Item]:
    """The items, with a progress bar on standard error."""
    return track(items, title, transient=True, console=Console(stderr=True))


def parse(parser: argparse.ArgumentParser, **smallest: object) -> argparse.Namespace:
    """Parse the command line. With `--smoke`, the arguments named in `smallest` get the values given
    there."""
    parser.add_argument(
        "--smoke", action="store_true", help="run at the smallest size, to see that the script works"
    )
    arguments = parser.parse_args()
    if arguments.smoke:
        vars(arguments).update(smallest)
    return arguments


def parts_of(text: str, known: Iterable[str]) -> list[str]:
    """Names separated by commas. Raises SystemExit, listing the known names, for an unknown one."""
    names = text.split(",")
    known = list(known)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise SystemExit(f"{unknown[0]!r} is unknown; known: {', '.join(known)}")
    return names


def use_processor_time() -> None:
    """Measure time limits in CPU time of this process, so that other work on the machine does not count."""
    time.perf_counter = time.process_time


def draw_hard_cases(family: str, count: int, folder: Path | None = None) -> list[Case]:
    """Held-out problems that the straight line does not solve and a search of ten seconds does. `folder`
    caches which problems these are."""
    with Console(stderr=True).status(f"problems of {family}") as status:
        return hard_cases(family, count, folder, status.update)


def dense(q: Float[ndarray, "n dof"], step: float) -> Float[ndarray, "m dof"]:
    """Configurations along the segments of a path, such that no joint moves by more than `step` [rad] between
    two of them."""
    parts = [q[:1]]
    for a, b in pairwise(q):
        count = max(int(np.ceil(np.abs(b - a).max() / step)), 1)
        parts.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(parts)


def limit_shares(robot: Robot, motion: Trajectory) -> Float[ndarray, "3"]:
    """The largest velocity, acceleration and jerk of any joint, as fractions of the joint's limits, checked
    every CHECK_STEP."""
    at = motion.at(np.arange(0.0, motion.duration, CHECK_STEP))
    limits = robot.velocity, robot.acceleration, jerk_limits(robot)
    rates = at.velocities, at.accelerations, motion.peak_jerks
    return np.array([np.abs(rate / limit).max() for rate, limit in zip(rates, limits, strict=True)])


class MeshContacts(NamedTuple):
    """Collisions of a motion's configurations on the meshes."""

    coal: int
    """Number of configurations in collision by Coal."""
    pybullet: bool
    """Whether any configuration is in collision by PyBullet."""


def contacts_on_meshes(
    problem: Problem, q: ndarray, tolerance: float = ORACLE_TOLERANCE, oracle: PyBulletOracle | None = None
) -> MeshContacts:
    """Check configurations by Coal and by PyBullet; a robot with a base or tool stands as in the world.

    tolerance: PyBullet ignores contacts that are less deep than this [m]. oracle: PyBullet with the same
    robot, which is reused because loading a robot takes 30 ms; None: a new one.
    """
    robot, scene = problem.robot_and_scene_in_world()
    coal = int(ExactCollision(problem.robot, problem.scene).collides(q).sum())
    with nullcontext(oracle) if oracle else PyBulletOracle(robot, scene) as bullet:
        if oracle:
            bullet.set_scene(scene)
        return MeshContacts(coal, bullet.check_rows(q, tolerance) is not None)
