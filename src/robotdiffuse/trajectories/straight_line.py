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
) -> Float[ndarray, "*batch"]:
    """Least time [s] from rest at `start` to rest at each goal along the straight line in joint space.

    Limits are per joint; inf is no limit. The velocity profile is a trapezoid or a triangle. Raises
    InputError if a limit is not positive.
    """
    for name, limit in (("velocity", velocity), ("acceleration", acceleration)):
        if not (np.asarray(limit) > 0).all():
            raise InputError(f"{name} is {limit}; it must be positive for each joint")
    distance = np.abs(goal - start)
    # Along the line, the traveled fraction of the distance grows from 0 to 1. v and a are the reciprocals of
    # the limits of its velocity and acceleration: those of the most limited joint.
    v = (distance / velocity).max(axis=-1)
    a = (distance / acceleration).max(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        speed_up = np.where(a == 0, 0.0, a / v)  # time to reach the velocity limit
    # in the second case, the velocity limit is not reached
    return np.where(speed_up <= v, v + speed_up, np.sqrt(4 * a))
