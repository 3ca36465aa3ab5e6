"""Torques and speeds along motions: finds the first one beyond its limit, or proves that there is none.

A motion consists of pieces with cubic or straight positions and smooth torques. Torques, or speeds of frames,
are computed at both ends of a piece. Where the bound on their second derivative (see robots/dynamics.py)
allows one beyond its limit in between, the piece is halved.
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
"""A piece is not halved further once its values are known to this fraction of their limits; a value that may
still exceed its limit counts as beyond it."""
MAX_OPEN_PIECES = 100_000
"""Maximum number of open pieces; if there are more, as in motions with very many turns, they count as beyond
the limit."""
PLACE_RESOLUTION = 1 / 64
"""The place where a value first exceeds its limit is located to this fraction of a piece."""
States = tuple[JointRows, JointRows, JointRows]
"""Positions, velocities and accelerations."""


class Pieces(NamedTuple):
    """The pieces of a motion, from each row to the next."""

    states: Callable[[Int[ndarray, "n"], Values], States]
    """States by piece and share of the piece."""
    along: Stretches
    """Bounds along each piece, with derivatives by the share."""


class Excess(NamedTuple):
    """The first value that exceeds its limit, or is not proved to be within it."""

    place: float
    """Row plus the share of the way to the next."""
    joint: int
    """Index of the joint, or of the frame."""
    torque: float
    """[N m] or [N]; of a frame its speed [m/s]."""
    excess: float
    """Largest excess along the motion, in the same unit."""


def trajectory_pieces(trajectory: Trajectory) -> Pieces:
    """Pieces of a trajectory, whose times increase: the cubics through its positions and velocities."""
    if len(trajectory.positions) == 1:
        return static_pieces(trajectory.positions)
    cubics = Cubics(trajectory)
    extremes = cubics.extremes
    h = cubics.steps
    change = np.abs(extremes.end - extremes.start)
    pull = np.stack([extremes.acceleration, change, np.zeros_like(change)])
    max_velocities = extremes.velocity
    speed = np.stack([max_velocities, h * pull[0], h * change])
    farthest = _farthest(trajectory.positions) + h * max_velocities / 2
    return Pieces(cubics.states, Stretches(farthest, h * speed, speed, pull))


def static_pieces(q: Configurations) -> Pieces:
    """Pieces of a path on straight lines, at rest everywhere."""
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
    return np.maximum(np.abs(q[:-1]), np.abs(q[1:]))


def first_excess(dynamics: Dynamics, pieces: Pieces, slack: float) -> Excess | None:
    """The first torque that exceeds its limit by more than a share `slack`; None if it is proved that none
    does."""
    bends = dynamics.second_derivatives(pieces.along)
    return first_beyond(dynamics.limits, dynamics.torques, bends, pieces.states, slack)


def first_beyond(
    limits: Values,
    values: Callable[[ndarray, ndarray, ndarray], ndarray],
    bends: Float[ndarray, "m k"],
    states: Callable[[ndarray, ndarray], States],
    slack: float,
) -> Excess | None:
    """The first of k `values` of states, such as torques, that exceeds its limit by more than a share
    `slack`; None if it is proved that none does.

    bends: bounds on the second derivatives of the values along each piece, by the share.
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
        bulge = bends[piece] * (high - low)[:, None] ** 2 / 8
        bound = np.maximum(at_low, at_high)
        open_ = bound + bulge > allowed
        begun = (at_low > allowed).any(axis=1)
        goes_on = (at_high > allowed).any(axis=1)
        unsure = np.minimum(bulge, RESOLUTION * limits)
        last = bulge <= unsure if len(piece) <= MAX_OPEN_PIECES else np.ones_like(open_)
        over = begun | goes_on
        lost = (open_ & last).any(axis=1)
        wrong = np.flatnonzero(over | lost)
        places.append(piece[wrong] + np.where(over & ~begun, high, low)[wrong])
        beyond.append((np.where(bound > allowed, bound, bound + unsure) - allowed)[wrong])
        unresolved = over & (begun != goes_on) & (high - low > PLACE_RESOLUTION)
        halved = open_.any(axis=1) & (unresolved | ~(over | lost))
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
