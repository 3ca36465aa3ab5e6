"""Bounds on second derivatives of torques along a motion, to show that limits hold between samples.

Between two samples, a torque deviates from linear interpolation by at most an eighth of its largest second
derivative times the square of the interval. Norms bound that derivative: inverse dynamics consists of sums
and products of vectors, and the Newton-Euler recursion propagates upper bounds on the lengths of each vector
and of its first two derivatives. A vector that is fixed in a body rotates with it and keeps its length.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

Jet = Float[ndarray, "3 n"]
"""Upper bounds on the length of a vector or number and of its first two derivatives, along n stretches of a
motion."""


class Stretches(NamedTuple):
    """Bounds for n stretches of a motion, on each of which the motion is smooth."""

    q: Float[ndarray, "n dof"]
    """Largest absolute joint positions."""
    v: Float[ndarray, "3 n dof"]
    """Largest absolute values of their first three derivatives."""
    speed: Float[ndarray, "3 n dof"]
    """Largest absolute joint velocities, and of their first two derivatives."""
    pull: Float[ndarray, "3 n dof"]
    """The same for joint accelerations. Velocities and accelerations are zero where the motion holds a
    position."""


class Body(NamedTuple):
    """The body that moves with a joint."""

    parent: int
    """Index of the joint before it; -1 if there is none."""
    slides: bool
    """Whether the joint is prismatic."""
    offset: float
    """Distance between the origins of both frames, at zero displacement of a prismatic joint [m]."""
    mass: float
    """[kg]"""
    lever: float
    """Distance of the centre of mass from the frame's origin [m]."""
    moment: float
    """Largest principal moment about the centre of mass [kg m²]."""


def product(a: Jet, b: Jet) -> Jet:
    """Bounds for a product of two vectors or numbers whose length is at most the product of their lengths."""
    return np.stack([a[0] * b[0], a[1] * b[0] + a[0] * b[1], a[2] * b[0] + 2 * a[1] * b[1] + a[0] * b[2]])


def second_derivative_bounds(bodies: list[Body], gravity: float, along: Stretches) -> Float[ndarray, "n dof"]:
    """Upper bounds on the second derivatives of torques, by the parameter of the stretches."""
    still = np.zeros((3, len(along.q)))
    weight = still.copy()
    weight[0] = gravity
    # per frame: rotation rate of the path, angular velocity, angular and linear acceleration of the dynamics
    frames: list[tuple[Jet, Jet, Jet, Jet]] = []
    axes: list[Jet] = []
    arms: list[Jet] = []
    for j, body in enumerate(bodies):
        turn, spin, angular, linear = (
            frames[body.parent] if body.parent >= 0 else (still, still, still, weight)
        )
        axis = _fixed(1.0, turn)
        arm = _fixed(body.offset, turn)
        v = along.v[:, :, j]
        speed = along.speed[:, :, j]
        pull = along.pull[:, :, j]
        along_axis = product(speed, axis)
        if body.slides:
            arm = arm + product(np.stack([along.q[:, j], v[0], v[1]]), axis)
        linear = linear + product(angular, arm) + product(spin, product(spin, arm))
        if body.slides:
            linear = linear + product(pull, axis) + 2 * product(spin, along_axis)
        else:
            angular = angular + product(pull, axis) + product(spin, along_axis)
            spin = spin + along_axis
            turn = turn + product(np.stack([v[0], v[1], v[2]]), axis)
        frames.append((turn, spin, angular, linear))
        axes.append(axis)
        arms.append(arm)
    forces = [still] * len(bodies)
    moments = [still] * len(bodies)
    found = np.empty(along.q.shape)
    for j in reversed(range(len(bodies))):
        body, (turn, spin, angular, linear) = bodies[j], frames[j]
        lever = _fixed(body.lever, turn)
        own = body.mass * (linear + product(angular, lever) + product(spin, product(spin, lever)))
        inertia = body.moment * np.stack([np.ones_like(turn[0]), 2 * turn[0], 2 * turn[1] + 4 * turn[0] ** 2])
        moment = product(inertia, angular) + product(spin, product(inertia, spin)) + product(lever, own)
        forces[j] = forces[j] + own
        moments[j] = moments[j] + moment
        found[:, j] = product(axes[j], forces[j] if body.slides else moments[j])[2]
        if body.parent >= 0:
            forces[body.parent] = forces[body.parent] + forces[j]
            moments[body.parent] = moments[body.parent] + moments[j] + product(arms[j], forces[j])
    return found


def _fixed(length: float, turn: Jet) -> Jet:
    """Bounds for a vector of constant length that rotates with its body."""
    return length * np.stack([np.ones_like(turn[0]), turn[0], turn[1] + turn[0] ** 2])
