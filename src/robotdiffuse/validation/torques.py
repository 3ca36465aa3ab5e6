"""Torques along motions: finds the first one beyond its limit, or proves that there is none.

A motion consists of pieces with cubic or straight positions and smooth torques. Torques are computed at both
ends of a piece. Where the bound on their second derivative (see robots/torque_bounds.py) allows a torque
beyond its limit in between, the piece is halved.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.types import Trajectory
from robotdiffuse.robots.dynamics import Dynamics
from robotdiffuse.robots.torque_bounds import Stretches

TORQUE_RESOLUTION = 1e-3
"""Halving ends where a torque is known up to this share of its limit; if it may exceed the limit, it counts
so."""
MAX_OPEN_PIECES = 100_000
"""Open pieces at most; if there are more, as in motions with very many turns, they count as beyond the
limit."""
PLACE_RESOLUTION = 1 / 64
"""The place where a torque first exceeds its limit is located to this share of a piece."""
States = tuple[Float[ndarray, "n dof"], Float[ndarray, "n dof"], Float[ndarray, "n dof"]]
"""Positions, velocities and accelerations."""


class Pieces(NamedTuple):
    """The pieces of a motion, from each row to the next."""

    states: Callable[[Int[ndarray, "n"], Float[ndarray, "n"]], States]
    """States by piece and share of the piece."""
    along: Stretches
    """Bounds along each piece, with derivatives by the share."""


class TorqueExcess(NamedTuple):
    """The first torque that exceeds its limit, or is not proved to be within it."""

    place: float
    """Row plus the share of the way to the next."""
    joint: int
    torque: float
    """[N m] or [N]"""
    excess: float
    """Largest excess of that joint along the motion [N m] or [N]."""


def trajectory_pieces(trajectory: Trajectory) -> Pieces:
    """Pieces of a trajectory, whose times increase: cubics through positions and velocities, and
    accelerations interpolated linearly."""
    q, v, a = trajectory.positions, trajectory.velocities, trajectory.accelerations
    if len(q) == 1:
        return static_pieces(q)
    h = np.diff(trajectory.times)[:, None]
    mean, change = np.diff(q, axis=0) / h, np.diff(a, axis=0)
    first, last = v[:-1] - mean, v[1:] - mean

    def states(piece: ndarray, share: ndarray) -> States:
        u, b, e = share[:, None], first[piece], last[piece]
        there = q[piece] + h[piece] * (u * mean[piece] + u * (1 - u) ** 2 * b - u**2 * (1 - u) * e)
        speeds = mean[piece] + (1 - u) * (1 - 3 * u) * b - u * (2 - 3 * u) * e
        return there, speeds, a[piece] + u * change[piece]

    # The velocity is a parabola in the share, which leaves its chord by an eighth of its second derivative.
    third = 6 * np.abs(first + last)
    second = np.maximum(np.abs(4 * first + 2 * last), np.abs(2 * first + 4 * last))
    most = np.maximum(np.abs(v[:-1]), np.abs(v[1:])) + third / 8
    speed = np.stack([most, second, third])
    pull = np.stack([np.maximum(np.abs(a[:-1]), np.abs(a[1:])), np.abs(change), np.zeros_like(change)])
    return Pieces(states, Stretches(_farthest(q) + h * most / 2, h * speed, speed, pull))


def static_pieces(q: Float[ndarray, "n dof"]) -> Pieces:
    """Pieces of a path on straight lines, at rest everywhere."""
    q = np.repeat(q, 2, axis=0) if len(q) == 1 else q
    step = np.diff(q, axis=0)
    still = np.zeros((3, *step.shape))

    def states(piece: ndarray, share: ndarray) -> States:
        there = q[piece] + share[:, None] * step[piece]
        return there, 0 * there, 0 * there

    v = still.copy()
    v[0] = np.abs(step)
    return Pieces(states, Stretches(_farthest(q), v, still, still))


def _farthest(q: Float[ndarray, "n dof"]) -> Float[ndarray, "m dof"]:
    return np.maximum(np.abs(q[:-1]), np.abs(q[1:]))


def first_excess(dynamics: Dynamics, pieces: Pieces, slack: float) -> TorqueExcess | None:
    """The first torque that exceeds its limit by more than a share `slack`; None if it is proved that none
    does."""
    allowed, bends = dynamics.limits * (1 + slack), dynamics.second_derivatives(pieces.along)
    count = len(bends)
    piece, low, high = np.arange(count), np.zeros(count), np.ones(count)

    def looked(piece: ndarray, share: ndarray) -> ndarray:
        return np.abs(dynamics.torques(*pieces.states(piece, share)))

    ends = looked(np.minimum(np.arange(count + 1), count - 1), np.append(np.zeros(count), 1.0))
    at_low, at_high = ends[:-1], ends[1:]
    places: list[ndarray] = [np.zeros(0)]
    torques: list[ndarray] = [np.zeros((0, len(allowed)))]
    while len(piece):
        bulge = bends[piece] * (high - low)[:, None] ** 2 / 8
        most = np.maximum(at_low, at_high)
        open_ = most + bulge > allowed
        begun, goes_on = (at_low > allowed).any(axis=1), (at_high > allowed).any(axis=1)
        unsure = np.minimum(bulge, TORQUE_RESOLUTION * dynamics.limits)
        last = bulge <= unsure if len(piece) <= MAX_OPEN_PIECES else np.ones_like(open_)
        over, lost = begun | goes_on, (open_ & last).any(axis=1)
        wrong = np.flatnonzero(over | lost)
        places.append(piece[wrong] + np.where(over & ~begun, high, low)[wrong])
        torques.append(np.where(most > allowed, most, most + unsure)[wrong])
        coarse = over & (begun != goes_on) & (high - low > PLACE_RESOLUTION)
        halved = open_.any(axis=1) & (coarse | ~(over | lost))
        piece, low, high = piece[halved], low[halved], high[halved]
        middle = (low + high) / 2
        at_middle = looked(piece, middle)
        at_low, at_high = at_low[halved], at_high[halved]
        at_low, at_high = np.concatenate([at_low, at_middle]), np.concatenate([at_middle, at_high])
        low, high, piece = np.append(low, middle), np.append(middle, high), np.tile(piece, 2)
    place, beyond = np.concatenate(places), np.concatenate(torques) - allowed
    if not len(place):
        return None
    i = int(place.argmin())
    j = int(beyond[i].argmax())
    return TorqueExcess(float(place[i]), j, float(beyond[i, j] + allowed[j]), float(beyond[:, j].max()))
