"""What the benchmarks share: the head of a report, tables, problems, processor time, and checks on meshes."""

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
from robotdiffuse.evaluation.problem_sets import hard_cases
from robotdiffuse.evaluation.report import processor, versions
from robotdiffuse.problems.held_out import Case
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.simulation.validator import PyBulletOracle
from robotdiffuse.trajectories.speed_limits import jerk_limits

Item = TypeVar("Item")
WIDTH = 120
"""Of printed tables [characters]."""
FIRST, CONVERGED, TIME_LIMIT = UNTIL
"""Values of `until`: stop at the first path, when more time stops paying, or at the time limit."""
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
    """Print a table whose columns line up, all but the first to the right."""
    show(Table.of(title, columns, rows, notes), width=WIDTH)


def progress(items: Sequence[Item], title: str) -> Iterable[Item]:
    """The items, with a progress bar on standard error."""
    return track(items, title, transient=True, console=Console(stderr=True))


def parse(parser: argparse.ArgumentParser, **smallest: object) -> argparse.Namespace:
    """Parse the command line; with `--smoke` the arguments named in `smallest` get these values."""
    parser.add_argument("--smoke", action="store_true", help="the smallest size, to see that the script runs")
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
    """Make time limits those of this process's CPU time, so that other work on the machine does not count."""
    time.perf_counter = time.process_time


def draw_hard_cases(family: str, count: int, folder: Path | None = None) -> list[Case]:
    """Held-out problems that the straight line does not solve and ten seconds of search do; `folder` keeps
    what is known of them."""
    with Console(stderr=True).status(f"problems of {family}") as status:
        return hard_cases(family, count, folder, status.update)


def dense(q: Float[ndarray, "n dof"], step: float) -> Float[ndarray, "m dof"]:
    """Configurations along the segments, no joint moving more than `step` [rad] between two of them."""
    parts = [q[:1]]
    for a, b in pairwise(q):
        count = max(int(np.ceil(np.abs(b - a).max() / step)), 1)
        parts.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(parts)


def limit_shares(robot: Robot, motion: Trajectory) -> Float[ndarray, "3"]:
    """The largest shares of the limits of velocity, acceleration and jerk, every CHECK_STEP."""
    at = motion.at(np.arange(0.0, motion.duration, CHECK_STEP))
    limits = robot.velocity, robot.acceleration, jerk_limits(robot)
    rates = at.velocities, at.accelerations, motion.peak_jerks
    return np.array([np.abs(rate / limit).max() for rate, limit in zip(rates, limits, strict=True)])


class MeshContacts(NamedTuple):
    """How many configurations of a motion collide on the meshes."""

    coal: int
    pybullet: bool
    """Whether any does."""


def contacts_on_meshes(
    problem: Problem, q: ndarray, tolerance: float = ORACLE_TOLERANCE, oracle: PyBulletOracle | None = None
) -> MeshContacts:
    """Check configurations by Coal and by PyBullet; a robot with a base or tool stands as in the world.

    `oracle`: of the same robot; it is kept open and gets the scene. Loading a robot takes 30 ms.
    """
    robot, scene = problem.standing()
    coal = int(ExactCollision(problem.robot, problem.scene).collides(q).sum())
    with nullcontext(oracle) if oracle else PyBulletOracle(robot, scene) as bullet:
        if oracle:
            bullet.set_scene(scene)
        return MeshContacts(coal, bullet.check_frames(q, tolerance) is not None)
