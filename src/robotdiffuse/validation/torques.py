"""Joint torques and frame speeds along motions: finds the first value that exceeds its limit, or proves that
no value does.

A motion consists of pieces, on which positions are straight or cubic and torques are smooth. Values are
computed at both ends of a piece. Bounds on their second derivatives (see robots/dynamics.py) bound the values
in between. If such a bound exceeds the limit, the piece is halved.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.types import Configurations, JointRows, Trajectory, Values
from robotdiffuse.robots.dynamics import Dynamics, Stretches
from robotdiffuse.trajectories.cubics import Cubics

RESOLUTION = 1e-3
"""A piece is not halved further once its values are known to this fraction of their limits. If a value may
still exceed its limit then, it counts as exceeding it."""
MAX_OPEN_PIECES = 100_000
"""Maximum number of pieces that are halved at once. If there are more, as in motions with very many turns,
each value that is not proved to be within its limit counts as exceeding it."""
PLACE_RESOLUTION = 1 / 64
"""Resolution of the place where a value first exceeds its limit, as a fraction of a step from row to row."""
States = tuple[JointRows, JointRows, JointRows]
"""Positions, velocities and accelerations."""


class Pieces(NamedTuple):
    """The pieces of a motion, from each row to the next."""

    states: Callable[[Int[ndarray, "n"], Values], States]
    """States at places. A place is the index of a piece, and a share: the fraction of the piece that has
    passed."""
    along: Stretches
    """Bounds on positions and derivatives along each piece; derivatives are with respect to the share."""


class Excess(NamedTuple):
    """The first value that exceeds its limit, or is not proved to be within its limit."""

    place: float
    """Row, plus the share of the piece after it."""
    column: int
    """Index of the joint, or of the frame."""
    value: float
    """The torque of the joint [N m] or [N], or the speed of the frame [m/s]."""
    excess: float
    """Largest amount by which this joint or frame exceeds its limit plus the allowed slack, anywhere on the
    motion, in the unit of `value`."""


def trajectory_pieces(trajectory: Trajectory) -> Pieces:
    """Pieces of a trajectory with increasing times: the cubics through its positions and velocities."""
    if len(trajectory.positions) == 1:
        return static_pieces(trajectory.positions)
    cubics = Cubics(trajectory)
    extremes = cubics.extremes
    h = cubics.steps
    change = np.abs(extremes.end - extremes.start)
    accelerations = np.stack([extremes.acceleration, change, np.zeros_like(change)])
    max_velocities = extremes.velocity
    speed = np.stack([max_velocities, h * accelerations[0], h * change])
    farthest = _farthest(trajectory.positions) + h * max_velocities / 2
    return Pieces(cubics.states, Stretches(farthest, h * speed, speed, accelerations))


def static_pieces(q: Configurations) -> Pieces:
    """Pieces of a path, on straight lines between waypoints, with zero velocity everywhere."""
    q = np.repeat(q, 2, axis=0) if len(q) == 1 else q
    step = np.diff(q, axis=0)
    still = np.zeros((3, *step.shape))

    def states(piece: ndarray, share: ndarray) -> States:
        configurations = q[piece] + share[:, None] * step[piece]
        return configurations, 0 * configurations, 0 * configurations

    v = still.copy()
    v[0] = np.abs(step)
    return Pieces(states, Stretches(_farthest(q), v, still, still))


def _farthest(q: Configurations) -> JointRows:
    """Largest absolute position of each joint at the ends of each piece."""
    return np.maximum(np.abs(q[:-1]), np.abs(q[1:]))


def first_excess(dynamics: Dynamics, pieces: Pieces, slack: float) -> Excess | None:
    """The first torque that exceeds its limit by more than the fraction `slack`; None if it is proved that no
    torque does."""
    bends = dynamics.second_derivatives(pieces.along)
    return first_beyond(dynamics.limits, dynamics.torques, bends, pieces.states, slack)


def first_beyond(
    limits: Values,
    values: Callable[[ndarray, ndarray, ndarray], ndarray],
    bends: Float[ndarray, "m k"],
    states: Callable[[ndarray, ndarray], States],
    slack: float,
) -> Excess | None:
    """The first value along a motion, such as a torque, that exceeds its limit by more than the fraction
    `slack`; None if it is proved that no value does.

    Args:
        limits: Limits of k values [k].
        values: Computes the k values [n, k] from n positions, velocities and accelerations.
        bends: Bounds on the second derivatives of the values with respect to the share, for each of m pieces.
        states: `Pieces.states`.
        slack: Allowed excess, as a fraction of a limit.
    """
    allowed = limits * (1 + slack)
    count = len(bends)
    piece = np.arange(count)
    low = np.zeros(count)
    high = np.ones(count)

    def magnitudes(piece: ndarray, share: ndarray) -> ndarray:
        return np.abs(values(*states(piece, share)))

    at_low = magnitudes(piece, low)
    at_high = magnitudes(piece, high)
    places: list[ndarray] = [np.zeros(0)]
    beyond: list[ndarray] = [np.zeros((0, len(allowed)))]
    while len(piece):
        # between the ends of [low, high], a value is at most the larger end value plus `bulge`
        bulge = bends[piece] * (high - low)[:, None] ** 2 / 8
        bound = np.maximum(at_low, at_high)
        undecided = bound + bulge > allowed
        low_exceeds = (at_low > allowed).any(axis=1)
        high_exceeds = (at_high > allowed).any(axis=1)
        unsure = np.minimum(bulge, RESOLUTION * limits)
        resolved = bulge <= unsure if len(piece) <= MAX_OPEN_PIECES else np.ones_like(undecided)
        exceeds = low_exceeds | high_exceeds
        unproved = (undecided & resolved).any(axis=1)
        wrong = np.flatnonzero(exceeds | unproved)
        places.append(piece[wrong] + np.where(exceeds & ~low_exceeds, high, low)[wrong])
        beyond.append((np.where(bound > allowed, bound, bound + unsure) - allowed)[wrong])
        # halve undecided intervals, and intervals with an excess at one end only, to locate the excess
        unlocated = exceeds & (low_exceeds != high_exceeds) & (high - low > PLACE_RESOLUTION)
        halved = undecided.any(axis=1) & (unlocated | ~(exceeds | unproved))
        piece = piece[halved]
        low = low[halved]
        high = high[halved]
        middle = (low + high) / 2
        at_middle = magnitudes(piece, middle)
        at_low = at_low[halved]
        at_high = at_high[halved]
        at_low = np.concatenate([at_low, at_middle])
        at_high = np.concatenate([at_middle, at_high])
        low = np.append(low, middle)
        high = np.append(middle, high)
        piece = np.tile(piece, 2)
    place = np.concatenate(places)
    excess = np.concatenate(beyond)
    if not len(place):
        return None
    i = int(place.argmin())
    j = int(excess[i].argmax())
    return Excess(float(place[i]), j, float(excess[i, j] + allowed[j]), float(excess[:, j].max()))
