"""Stops a motion under way before an obstacle that appears in its way.

The stop follows the path of the motion, slower and slower until the arm rests. So it passes only
configurations that were validated when the motion was planned; they are validated again among the obstacles
that were seen since then.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from scipy.interpolate import BSpline

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.occupancy_map import APPEARED_PADDING
from robotdiffuse.perception.seen_points import seen_shapes
from robotdiffuse.perception.voxel_grid import MAP, Voxels
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud
from robotdiffuse.trajectories.speed_limits import jerk_limits
from robotdiffuse.validation.validator import verifier

ROW_TIME = 0.004
"""Largest time between the rows while a stop brakes [s]."""
LEAST_STEP = 1e-3
"""Smallest time between the rows of a stop [s]; a stop takes at least this long."""
DELAY_STEP = 0.02
"""Step between the times at which braking may begin [s]."""
BRAKING_TIMES = 0.05 * 1.12 ** np.arange(35)
"""Durations of braking that are tried, the shortest first [s]."""
RAMPS = (0.1, 0.25, 0.5)
"""Fractions of the braking time that are tried for the rise of the deceleration, and for its fall."""
LIMIT_TOLERANCE = 1e-3
"""Accelerations and jerks may exceed their limits by this fraction of the limit."""


@dataclass(frozen=True, eq=False)
class Stop:
    """How a motion ends early."""

    begins: float
    """When the stop replaces the motion, in time of the motion [s]."""
    motion: Trajectory
    """The stop, from this time on; it ends at rest on the path of the motion."""
    reason: str
    """The violation that the motion would have: what is in the way."""
    certified: bool
    """Whether the validator accepts the stop among all that was seen; if not, the arm cannot stop in time."""


def stop_before(
    robot: Robot,
    known: Scene,
    views: Sequence[DepthView],
    free: Voxels,
    motion: Trajectory,
    time: float,
) -> Stop | None:
    """A stop that begins at `time` and comes to rest as early as possible, if views show an obstacle in the
    way of the rest of the motion; otherwise None.

    The stop is within the robot's limits of velocity, acceleration and jerk. Points in space that was free
    before belong to an object that appeared; these points are padded, since only the object's front is seen.

    views: views taken during the motion. free: `OccupancyMap.free` when the motion was planned. time: when a
    new command takes effect, in time of the motion [s]. Raises InputError for a time outside the motion.
    """
    if not 0 <= time <= motion.duration:
        raise InputError(f"time is {shown(time)}; it must be in [0, {motion.duration:.4g}] s of the motion")
    current = motion.at(time).positions
    end = motion.positions[-1]
    seen = seen_shapes(views, robot, known, current, end[None])
    points = np.concatenate([np.zeros((0, 3)), *(shape.points for shape in seen)])
    appeared = PointCloud(points[MAP.enclose(free, points, MAP.edge)], APPEARED_PADDING, name="appeared")
    validator = verifier(Problem(robot, known.with_shapes([*known.shapes, *seen, appeared]), current, end))
    remaining = np.concatenate([current[None], motion.positions[motion.times > time]])
    violation = validator.path(Path(robot.joint_names, remaining)).violation
    if violation is None:
        return None
    stop = braked(robot, motion, time)
    certified = validator.collision_free(Path(robot.joint_names, stop.positions))
    return Stop(time, stop, violation.message, certified)


def braked(robot: Robot, motion: Trajectory, time: float) -> Trajectory:
    """The motion from `time` on, slowed to rest after as little of the path as the limits allow. It stays on
    the path. If no braking that was tried keeps the limits, it is the rest of the motion. Braking for b
    seconds uses up b / 2 of the motion's time."""
    used = motion.duration - time
    best = _rows(motion, time, max(used, LEAST_STEP), 0.0, RAMPS[0])
    for delay in np.arange(0.0, used, DELAY_STEP):
        for braking, ramp in product(BRAKING_TIMES, RAMPS):
            if delay + braking / 2 >= used:
                break
            candidate = _rows(motion, time, float(delay), float(braking), ramp)
            if _within_limits(robot, candidate):
                best = candidate
                used = delay + braking / 2
                break
    return best


def _rows(motion: Trajectory, time: float, delay: float, braking: float, ramp: float) -> Trajectory:
    """The motion from `time` on: unchanged for `delay` [s], then slowed to rest in `braking` [s].

    While braking, the motion's time passes with a speed that falls from 1 to 0. The deceleration of this
    speed is a trapezoid: it rises for `ramp` of the braking time, is constant, and falls for `ramp`.
    """
    # rows at other times than the motion's would change its accelerations
    after = motion.times - time
    unchanged = after[(after > LEAST_STEP) & (after < delay - LEAST_STEP)]
    slowed = np.linspace(delay, delay + braking, int(braking / ROW_TIME) + 2)
    times = np.unique([0.0, *unchanged, *slowed])
    scale = max(braking, ROW_TIME)  # `braking` is 0 if the motion does not brake
    u = np.maximum(times - delay, 0.0) / scale
    slowing, loss, lost_time = _braking(ramp)
    passed = times + braking * lost_time(u)  # time of the motion
    q, v, a, _ = motion.at(np.minimum(time + passed, motion.duration))
    speed = 1 + loss(u)[:, None]
    return Trajectory(motion.joint_names, times, q, v * speed, a * speed**2 + v * slowing(u)[:, None] / scale)


@lru_cache
def _braking(ramp: float) -> tuple[BSpline, BSpline, BSpline]:
    """Functions of the fraction of the braking time that has passed: the derivative of the speed at which the
    motion's time passes, the change of this speed, and the integral of this change. All are negative."""
    peak = 1 / (1 - ramp)
    slowing = BSpline([0, 0, ramp, 1 - ramp, 1, 1], np.array([0, -peak, -peak, 0]), 1)
    loss = slowing.antiderivative()
    return slowing, loss, loss.antiderivative()


def _within_limits(robot: Robot, motion: Trajectory) -> bool:
    start, end = motion.cubic_accelerations
    jerks = (end - start) / np.diff(motion.times)[:, None]
    limits = np.array([robot.acceleration, robot.acceleration, jerk_limits(robot)])
    return bool((np.abs([start, end, jerks]) <= (1 + LIMIT_TOLERANCE) * limits[:, None]).all())
