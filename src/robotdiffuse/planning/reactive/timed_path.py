"""A path that is certified among what stands still, and how fast the arm goes along it."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories import braking_kernel
from robotdiffuse.trajectories.corner_rounding import BlendedPolyline, half_widths
from robotdiffuse.trajectories.speed_limits import TimingSettings, symmetric_bounds, timing_grid
from robotdiffuse.trajectories.timing import rounded_corners
from robotdiffuse.trajectories.timing_kernel import controllable, sample_rows
from robotdiffuse.validation.validator import Verifier

VELOCITY, ACCELERATION = 0.99, 0.96
"""Shares of the limits: what may happen between the places where they are kept."""
APART = 1e-4
"""Courses are longer than this [rad]."""
FINE = 0.03
"""Intervals in which the arm may stop are about so long [rad, joint-space L2]."""


CORNER = 16
"""Intervals in a rounded corner."""


class Speeds(NamedTuple):
    """A motion along a course: values of s, and the speed at each."""

    s: Float[ndarray, "m"]
    speeds: Float[ndarray, "m"]

    def after(self, time: float) -> tuple[float, float]:
        """s and speed some time after the beginning [s]."""
        return braking_kernel.state_after(self.s, self.speeds, time)

    def rest(self, time: float) -> "Speeds":
        """What is left of it some time after the beginning [s]."""
        s, speed = self.after(time)
        ahead = self.s > s + 1e-12
        return Speeds(np.append(s, self.s[ahead]), np.append(speed, self.speeds[ahead]))

    @property
    def duration(self) -> float:
        """Until the arm rests [s]."""
        both = self.speeds[1:] + self.speeds[:-1]
        return float((2 * np.diff(self.s)[both > 0] / both[both > 0]).sum())


@dataclass(frozen=True, eq=False)
class Course:
    """A polyline with rounded corners that passed the validator, along which the arm need not stop."""

    robot: Robot
    line: BlendedPolyline
    to_goal: bool
    """Whether it, or what follows, ends at the goal."""
    then: "Course | None" = None
    """What follows after a stop at its end."""

    @staticmethod
    def certified(
        robot: Robot, validator: Verifier, waypoints: Float[ndarray, "n dof"], to_goal: bool
    ) -> "Course | None":
        """The course through waypoints; None where the validator does not find them free, or all are the same."""
        path = Path(robot.joint_names, waypoints)
        if path.length < APART or not validator.collision_free(path):
            return None

        def free(motion: Trajectory) -> bool:
            return validator.collision_free(Path(motion.joint_names, motion.positions))

        rows, deviations = rounded_corners(robot, path, free, validator.collision_free)
        stops = [0, *(np.flatnonzero(deviations == 0) + 1).tolist(), len(rows) - 1]
        course = None
        for first, last in reversed(list(pairwise(stops))):
            part = rows[first : last + 1]
            line = BlendedPolyline(part, half_widths(part, deviations[first : last - 1]))
            course = Course(robot, line, to_goal, course)
        return course

    @cached_property
    def _grid(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """The path's derivatives at the values of s where limits are kept, these, and the most ṡ² there."""
        count = max(int(self.line.length / FINE), 8)
        grid = timing_grid(self.line, TimingSettings(line_intervals=count, corner_intervals=CORNER))
        one, two = self.line(grid, 1), self.line(grid, 2)
        return (
            one,
            two,
            grid,
            controllable(
                one,
                two,
                grid,
                VELOCITY * self.robot.velocity,
                *symmetric_bounds(self._acceleration, len(grid)),
            ),
        )

    @property
    def _acceleration(self) -> Float[ndarray, "dof"]:
        return ACCELERATION * self.robot.acceleration

    def on_then_rest(self, s: float, speed: float, time: float) -> Speeds:
        """As fast as possible towards the end for some time [s], then braking to rest."""
        return Speeds(*braking_kernel.advance_then_brake(*self._grid, s, speed, time, self._acceleration))

    def onwards(self, s: float, speed: float) -> Speeds:
        """The fastest motion to the end."""
        return self.on_then_rest(s, speed, np.inf)

    @property
    def end(self) -> float:
        """A little before the last s."""
        return self.line.length - 1e-9

    def at(self, s: float) -> Float[ndarray, "dof"]:
        """The configuration at s."""
        return self.line(np.array([s]), 0)[0]

    def remaining(self, s: float) -> Float[ndarray, "n dof"]:
        """Waypoints from s to the end of what follows."""
        ahead = self.line.waypoints[self.line.knots > s + APART]
        after = self.then.remaining(0.0)[1:] if self.then is not None else ahead[:0]
        return np.concatenate([self.at(s)[None], ahead, after])

    def rows(self, speeds: Speeds, sample_time: float) -> Trajectory:
        """The motion; two rows at rest where there is none."""
        if speeds.duration <= 0:
            q = np.repeat(self.at(float(speeds.s[0]))[None], 2, axis=0)
            return Trajectory(self.robot.joint_names, np.array([0.0, sample_time]), q, 0 * q, 0 * q)
        moving = np.append(True, (speeds.speeds[1:] + speeds.speeds[:-1]) > 0)
        rows = sample_rows(self.line.arrays, speeds.s[moving], speeds.speeds[moving], sample_time)
        return Trajectory(self.robot.joint_names, *rows)
