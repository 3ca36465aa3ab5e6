"""Closed-form minimum time of straight lines in joint space from rest to rest, a lower bound of the duration
of timed motions along them."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Configuration, JointValues


def straight_line_time(
    start: Configuration,
    goal: Float[ndarray, "*batch dof"],
    velocity: JointValues,
    acceleration: JointValues,
    jerk: JointValues | None = None,
) -> Float[ndarray, "*batch"]:
    """Least time [s] from rest at `start` to rest at each goal along the straight line in joint space.

    Limits are per joint; inf is no limit. For `jerk`, None or a joint's 0 is no limit either. The velocity
    profile is a trapezoid, or a double S with a jerk limit. Raises InputError if a velocity or acceleration
    limit is not positive.
    """
    for name, limit in (("velocity", velocity), ("acceleration", acceleration)):
        if not (np.asarray(limit) > 0).all():
            raise InputError(f"{name} is {limit}; it must be positive for each joint")
    distance = np.abs(goal - start)
    # Along the line, the traveled fraction of the distance grows from 0 to 1. v, a and j are the reciprocals
    # of the limits of its velocity, acceleration and jerk: those of the most limited joint.
    v = (distance / velocity).max(axis=-1)
    a = (distance / acceleration).max(axis=-1)
    if jerk is None:
        j = np.zeros_like(v)
    else:
        j = np.divide(distance, jerk, out=np.zeros_like(distance), where=jerk > 0).max(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # time to reach the velocity limit; first case: the acceleration limit is reached on the way
        speed_up = np.where(a * a >= j * v, a / v + j / a, 2 * np.sqrt(j / v))
        speed_up = np.where((a == 0) & (j == 0), 0.0, speed_up)
        # the whole time if the velocity limit is not reached; first case: the acceleration limit is reached
        ramp = j / a
        triangular_time = np.where(2 * j * j <= a**3, ramp + np.sqrt(ramp * ramp + 4 * a), 4 * np.cbrt(j / 2))
        return np.where(
            distance.max(axis=-1) == 0, 0.0, np.where(speed_up <= v, v + speed_up, triangular_time)
        )
