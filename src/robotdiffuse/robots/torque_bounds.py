"""How torques bend along a motion, at most: what shows that they keep their limits between two looks.

A torque leaves the chord between two looks by at most an eighth of its greatest second derivative times the
square of what is between them. That derivative is bounded by norms: inverse dynamics is sums and products of
vectors, and the recursion of Newton and Euler carries along how long each is at most, and how long its first
two derivatives are. A vector that is fixed in a body turns with it and keeps its length.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

Jet = Float[ndarray, "3 n"]
"""Of a vector or number along n stretches of a motion: its length at most, and those of its derivatives."""


class Stretches(NamedTuple):
    """n stretches of a motion, on each of which all of this is smooth."""

    q: Float[ndarray, "n dof"]
    """Size of positions at most, ..."""
    v: Float[ndarray, "3 n dof"]
    """... of their first three derivatives, ..."""
    speed: Float[ndarray, "3 n dof"]
    """... of the velocities that joints have and two derivatives, ..."""
    pull: Float[ndarray, "3 n dof"]
    """... and of accelerations. Positions that are held have neither, however far apart they are."""


class Body(NamedTuple):
    """What moves with a joint, and where that hangs."""

    parent: int
    """Number of the joint before it; -1: none."""
    slides: bool
    offset: float
    """Between the origins of both frames, without what a sliding joint adds [m]."""
    mass: float
    lever: float
    """Of the centre of mass [m]."""
    moment: float
    """Greatest about the centre of mass [kg m²]."""


def times(a: Jet, b: Jet) -> Jet:
    """Of a product of any kind whose length is at most that of both factors."""
    return np.stack([a[0] * b[0], a[1] * b[0] + a[0] * b[1], a[2] * b[0] + 2 * a[1] * b[1] + a[0] * b[2]])


def bend(bodies: list[Body], gravity: float, along: Stretches) -> Float[ndarray, "n dof"]:
    """Second derivatives of torques at most."""
    still = np.zeros((3, len(along.q)))
    weight = still.copy()
    weight[0] = gravity
    # of each frame: its turning as it is seen, that of the dynamics, its angular and linear acceleration
    frames: list[tuple[Jet, Jet, Jet, Jet]] = []
    axes: list[Jet] = []
    arms: list[Jet] = []
    for j, body in enumerate(bodies):
        turn, spin, angular, linear = (
            frames[body.parent] if body.parent >= 0 else (still, still, still, weight)
        )
        axis, arm = _fixed(1.0, turn), _fixed(body.offset, turn)
        v, speed, pull = along.v[:, :, j], along.speed[:, :, j], along.pull[:, :, j]
        along_axis = times(speed, axis)
        if body.slides:
            arm = arm + times(np.stack([along.q[:, j], v[0], v[1]]), axis)
        linear = linear + times(angular, arm) + times(spin, times(spin, arm))
        if body.slides:
            linear = linear + times(pull, axis) + 2 * times(spin, along_axis)
        else:
            angular = angular + times(pull, axis) + times(spin, along_axis)
            spin = spin + along_axis
            turn = turn + times(np.stack([v[0], v[1], v[2]]), axis)
        frames.append((turn, spin, angular, linear))
        axes.append(axis)
        arms.append(arm)
    forces, moments = [still] * len(bodies), [still] * len(bodies)
    found = np.empty(along.q.shape)
    for j in reversed(range(len(bodies))):
        body, (turn, spin, angular, linear) = bodies[j], frames[j]
        lever = _fixed(body.lever, turn)
        own = body.mass * (linear + times(angular, lever) + times(spin, times(spin, lever)))
        inertia = body.moment * np.stack([np.ones_like(turn[0]), 2 * turn[0], 2 * turn[1] + 4 * turn[0] ** 2])
        moment = times(inertia, angular) + times(spin, times(inertia, spin)) + times(lever, own)
        forces[j], moments[j] = forces[j] + own, moments[j] + moment
        found[:, j] = times(axes[j], forces[j] if body.slides else moments[j])[2]
        if body.parent >= 0:
            forces[body.parent] = forces[body.parent] + forces[j]
            moments[body.parent] = moments[body.parent] + moments[j] + times(arms[j], forces[j])
    return found


def _fixed(length: float, turn: Jet) -> Jet:
    """A vector of a length that turns with its body."""
    return length * np.stack([np.ones_like(turn[0]), turn[0], turn[1] + turn[0] ** 2])
