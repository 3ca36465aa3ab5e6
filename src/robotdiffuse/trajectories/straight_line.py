"""Least time of straight lines in joint space, from rest to rest: a lower bound for how fast paths along them
can be timed, in closed form."""

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

    Limits are per joint; they may be inf. `jerk`: None, or 0 for a joint, is no limit. The profile is
    trapezoidal without a jerk limit and a double S with one. Raises InputError if a velocity or acceleration
    limit is not positive.
    """
    for name, limit in (("velocity", velocity), ("acceleration", acceleration)):
        if not (np.asarray(limit) > 0).all():
            raise InputError(f"{name} is {limit}; it must be positive for each joint")
    distance = np.abs(goal - start)
    # Along the line the share of the way done goes from 0 to 1: these are one over the limits of its rates.
    v = (distance / velocity).max(axis=-1)
    a = (distance / acceleration).max(axis=-1)
    if jerk is None:
        j = np.zeros_like(v)
    else:
        j = np.divide(distance, jerk, out=np.zeros_like(distance), where=jerk > 0).max(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # to the greatest velocity, with and without reaching the greatest acceleration
        speed_up = np.where(a * a >= j * v, a / v + j / a, 2 * np.sqrt(j / v))
        speed_up = np.where((a == 0) & (j == 0), 0.0, speed_up)
        ramp = j / a
        triangular_time = np.where(2 * j * j <= a**3, ramp + np.sqrt(ramp * ramp + 4 * a), 4 * np.cbrt(j / 2))
        return np.where(
            distance.max(axis=-1) == 0, 0.0, np.where(speed_up <= v, v + speed_up, triangular_time)
        )
