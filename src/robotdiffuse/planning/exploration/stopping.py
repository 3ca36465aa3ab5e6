"""Ends a motion under way before what appears in its way.

The arm leaves its motion in time, not in space: it follows the same path, slower and slower, until it rests.
So the stop passes no configuration that the motion would not have passed, and stays within what was validated
when the motion was planned; what was seen since then is validated anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.types import Path, Points, Trajectory
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.seen_points import seen_shapes
from robotdiffuse.perception.voxel_grid import MAP, Voxels
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud
from robotdiffuse.trajectories.speed_limits import jerk_limits
from robotdiffuse.validation.validator import verifier

ROW_TIME = 0.004
"""Time between the rows of a stop [s]."""
BRAKING_DELAY = 0.02
"""Between the times at which braking is tried to begin [s]."""
BRAKING_TIMES = 0.05 * 1.12 ** np.arange(35)
"""How long braking may take, the shortest first [s]."""
RAMPS = (0.1, 0.25, 0.5)
"""Shares of the braking time in which the deceleration rises, and falls again."""
LIMIT_TOLERANCE = 1e-3
"""Rates may exceed their limits by this part of them."""
APPEARED_PADDING = 0.05
"""Radius of points that appeared where space was free [m]."""


@dataclass(frozen=True, eq=False)
class Stop:
    """How a motion ends early."""

    begins: float
    """When the stop takes over, on the clock of the motion that it ends [s]."""
    motion: Trajectory
    """From then on; ends at rest on the path of the motion that it ends."""
    reason: str
    """What is in the way."""
    certified: bool
    """Whether the validator accepts the stop among what was seen; else the arm comes too near before it can
    stop."""


def stop_before(
    robot: Robot,
    known: Scene,
    views: Sequence[DepthView],
    free: Voxels,
    motion: Trajectory,
    time: float,
) -> Stop | None:
    """The earliest stop from a time of a motion on, if views show something in the way of its rest; None if
    they do not.

    Points where space was free before appeared: they are obstacles with a padding, since only the front of
    what they belong to is seen. views: taken during the motion. free: voxels of `OccupancyMap.free` when the
    motion was planned. time: when a new command takes effect, on the motion's clock [s]. Velocities,
    accelerations and jerks are within the robot's limits. Raises InputError for a time outside of the motion.
    """
    if not 0 <= time <= motion.duration:
        raise InputError(f"time is {shown(time)}; it must be in [0, {motion.duration:.4g}] s of the motion")
    current = motion.at(time).positions
    end = motion.positions[-1]
    seen = seen_shapes(views, robot, known, current, end[None])
    points = np.concatenate([np.zeros((0, 3)), *(shape.points for shape in seen)])
    appeared = PointCloud(points[_within(points, free)], APPEARED_PADDING, name="appeared")
    validator = verifier(Problem(robot, known.with_shapes([*known.shapes, *seen, appeared]), current, end))
    rest = np.concatenate([current[None], motion.positions[motion.times > time]])
    violation = validator.path(Path(robot.joint_names, rest)).violation
    if violation is None:
        return None
    stop = braked(robot, motion, time)
    certified = validator.collision_free(Path(robot.joint_names, stop.positions))
    return Stop(time, stop, violation.message, certified)


def _within(points: Points, free: Voxels) -> Bool[ndarray, "n"]:
    """Which points lie in free voxels with free voxels on all six sides."""
    at = MAP.indices(points)
    within = np.asarray(((at > 0) & (at < np.array(free.shape) - 1)).all(axis=1))
    for side in ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)):
        within[within] = free[tuple((at[within] + side).T)]
    return within


def braked(robot: Robot, motion: Trajectory, time: float) -> Trajectory:
    """The motion from a time on that rests as early as possible, on the same path and within the limits."""
    best = _rows(motion, time, motion.duration - time, 0.0, RAMPS[0])
    stop_time = motion.duration
    for delay in np.arange(0.0, motion.duration - time, BRAKING_DELAY):
        for braking, ramp in product(BRAKING_TIMES, RAMPS):
            if time + delay + braking / 2 >= stop_time:
                break
            candidate = _rows(motion, time, float(delay), float(braking), ramp)
            if _within_limits(robot, candidate):
                best = candidate
                stop_time = time + delay + braking / 2
                break
    return best


def _rows(motion: Trajectory, time: float, delay: float, braking: float, ramp: float) -> Trajectory:
    """The motion from `time` on, for a delay as it is, then slowed to rest.

    Its own time runs on with a speed that falls from 1 to 0 in the braking time. The deceleration rises, is
    constant and falls, like a trapezoid.
    """
    duration = delay + braking
    count = max(int(np.ceil(duration / ROW_TIME)), 1)
    times = duration * np.arange(count + 1) / count
    passed = times
    speed = np.ones(count + 1)
    slowing = np.zeros(count + 1)
    if braking > 0:
        u = np.clip((times - delay) / braking, 0.0, 1.0)
        peak = 1 / (1 - ramp)
        remaining = 1 - u
        parts = [u < ramp, u <= 1 - ramp]
        early = u - peak * u**3 / (6 * ramp)
        middle = u - peak * (u**2 / 2 - ramp * u / 2 + ramp**2 / 6)
        ways = [early, middle, 0.5 - peak * remaining**3 / (6 * ramp)]
        passed = np.where(times < delay, times, delay + braking * np.select(parts, ways[:2], ways[2]))
        slower = [peak * u**2 / (2 * ramp), peak * (u - ramp / 2)]
        speed = 1 - np.select(parts, slower, 1 - peak * remaining**2 / (2 * ramp))
        slowing = -np.select(parts, [peak * u / ramp, peak + 0 * u], peak * remaining / ramp) / braking
    q, v, a, _ = motion.at(np.minimum(time + passed, motion.duration))
    speed = speed[:, None]
    slowing = slowing[:, None]
    return Trajectory(motion.joint_names, times, q, v * speed, a * speed**2 + v * slowing)


def _within_limits(robot: Robot, motion: Trajectory) -> bool:
    jerks = np.diff(motion.accelerations, axis=0) / np.diff(motion.times)[:, None]
    return bool(
        (np.abs(motion.accelerations) <= (1 + LIMIT_TOLERANCE) * robot.acceleration).all()
        and (np.abs(jerks) <= (1 + LIMIT_TOLERANCE) * jerk_limits(robot)).all()
    )
