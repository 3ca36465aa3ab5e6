"""Ends a motion under way before what appears in its way.

The arm leaves its motion in time, not in space: it follows the same path, slower and slower, until it rests.
So the stop passes no configuration that the motion would not have passed, and stays within what was validated
when the motion was planned; what was seen since then is validated anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.seen_points import seen_shapes
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.trajectories.speed_limits import jerk_limits
from robotdiffuse.validation.validator import verifier

ROW_TIME = 0.004
"""Time between the rows of a stop [s]."""
BRAKING_DELAY = 0.02
"""Between the times at which braking is tried to begin [s]."""
BRAKING_TIMES = 0.1 * 1.15 ** np.arange(26)
"""How long braking may take, the shortest first [s]."""
LIMIT_TOLERANCE = 1e-3
"""Rates may exceed their limits by this part of them."""


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
    robot: Robot, known: Scene, views: Sequence[DepthView], motion: Trajectory, time: float
) -> Stop | None:
    """The earliest stop from a time of a motion on, if views show something in the way of its rest; None if
    they do not.

    views: taken during the motion. time: when a new command takes effect, on the motion's clock [s].
    Velocities, accelerations and jerks are within the robot's limits. Raises InputError for a time outside of
    the motion.
    """
    if not 0 <= time <= motion.duration:
        raise InputError(f"time is {shown(time)}; it must be in [0, {motion.duration:.4g}] s of the motion")
    here, end = motion.at(time).positions, motion.positions[-1]
    seen = seen_shapes(views, robot, known, here, end[None])
    if not seen:
        return None
    problem = Problem(robot, known.with_shapes([*known.shapes, *seen]), here, end)
    ahead = motion.times > time
    rest = Path(robot.joint_names, np.concatenate([here[None], motion.positions[ahead]]))
    violation = verifier(problem).path(rest).violation
    if violation is None:
        return None
    stop = braked(robot, motion, time)
    certified = verifier(problem).collision_free(Path(robot.joint_names, stop.positions))
    return Stop(time, stop, violation.message, certified)


def braked(robot: Robot, motion: Trajectory, time: float) -> Trajectory:
    """The motion from a time on that rests as early as possible, on the same path and within the limits."""
    best, rests = _rows(motion, time, motion.duration - time, 0.0), motion.duration
    for delay in np.arange(0.0, motion.duration - time, BRAKING_DELAY):
        for braking in BRAKING_TIMES:
            if time + delay + braking / 2 >= rests:
                break
            found = _rows(motion, time, float(delay), float(braking))
            if _within_limits(robot, found):
                best, rests = found, time + delay + braking / 2
                break
    return best


def _rows(motion: Trajectory, time: float, delay: float, braking: float) -> Trajectory:
    """The motion from `time` on, for a delay as it is, then slowed to rest.

    Its own time runs on with a speed that falls from 1 to 0 as 1 - (10 u³ - 15 u⁴ + 6 u⁵), u being the share
    of the braking time that is over.
    """
    duration = delay + braking
    count = max(int(np.ceil(duration / ROW_TIME)), 1)
    times = duration * np.arange(count + 1) / count
    u = np.clip((times - delay) / braking, 0.0, 1.0) if braking > 0 else np.zeros(count + 1)
    passed = np.where(times < delay, times, delay + braking * (u - 2.5 * u**4 + 3 * u**5 - u**6))
    speed = 1 - u**3 * (10 - 15 * u + 6 * u**2)
    slowing = -30 * u**2 * (1 - u) ** 2 / braking if braking > 0 else np.zeros(count + 1)
    q, v, a, _ = motion.at(np.minimum(time + passed, motion.duration))
    speed, slowing = speed[:, None], slowing[:, None]
    return Trajectory(motion.joint_names, times, q, v * speed, a * speed**2 + v * slowing)


def _within_limits(robot: Robot, motion: Trajectory) -> bool:
    jerks = np.diff(motion.accelerations, axis=0) / np.diff(motion.times)[:, None]
    return bool(
        (np.abs(motion.accelerations) <= (1 + LIMIT_TOLERANCE) * robot.acceleration).all()
        and (np.abs(jerks) <= (1 + LIMIT_TOLERANCE) * jerk_limits(robot)).all()
    )
