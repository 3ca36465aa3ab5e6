"""Compiled simplification of paths: removing waypoints, smoothing corners, tightening.

Corners are smoothed by B-spline subdivision as in W. Thomason, Z. Kingston and L. Kavraki, "Motions in
Microseconds via Vectorized Sampling-Based Planning", ICRA 2024, and in OMPL's path simplifier.
"""

import numpy as np

from robotdiffuse.collision.kernels.motions import distance, make_scratch, motion_free, path_length
from robotdiffuse.collision.kernels.random import random
from robotdiffuse.core.kernels import HALF, ONE, TINY, inner_kernel, kernel

MAX_SUBDIVISIONS = 5
"""Largest number of subdivisions in a round of corner smoothing."""
MIN_MOVE = np.float32(0.005)
"""Smallest move of a corner by smoothing, and smallest length of a segment after a move by tightening [rad,
joint-space L2]."""
MIN_GAIN = np.float32(1e-3)
"""Simplification ends after a round that shortens the path by less than this fraction of its length."""
REMOVE_SHARE = np.float32(0.1)
"""Fraction of the attempts of tightening that remove a waypoint: those whose random number is below it."""
PULL_SHARE = np.float32(0.35)
"""The other attempts move a waypoint towards the chord of its neighbors. If their random number is at least
PULL_SHARE, a random move is added."""
MAX_RANDOM_MOVE = np.float32(0.3)
"""Largest scale of random moves of a waypoint, in each joint [rad]."""
RANDOM_MOVE_LOG_RANGE = np.float32(5.0)
"""Natural logarithm of the ratio of the largest to the smallest scale of random moves."""


@kernel(nogil=True)
def simplify(space, path, rounds):
    """A free path [n, dof] that is not longer than the free path `path` and has its start and goal.

    Waypoints that a straight line can skip are removed. Each of at most `rounds` rounds then smooths corners
    and removes such waypoints again.
    """
    scratch = make_scratch(space, space.lower)
    points = _skipped(space, path, scratch)
    length = path_length(points)
    for _ in range(rounds):
        if len(points) <= 2:
            return points
        smooth = _skipped(space, _smoothed(space, points, scratch), scratch)
        shorter = path_length(smooth)
        # Smoothing splits segments without a check. The halves are sampled at other configurations than the
        # whole segment was, so the path is checked again.
        if shorter >= length or not _free(space, smooth, scratch):
            break
        points = smooth
        if shorter > length * (ONE - MIN_GAIN):
            break
        length = shorter
    return points


@kernel(nogil=True)
def tighten(space, path, tries, state):
    """A free path [n, dof] near the free path `path` that is not longer and has its start and goal.

    Each of `tries` attempts removes or moves a random waypoint. Smoothing ends with paths a little longer
    than the shortest path of the homotopy class. Tightening comes closer without new corners, which would
    slow the motion down. state: of the random generator.
    """
    scratch = make_scratch(space, space.lower)
    points = path.copy()
    n = len(path)
    for _ in range(tries):
        if n <= 2:
            break
        i = 1 + min(int(random(state) * np.float32(n - 2)), n - 3)
        change = random(state)
        if change < REMOVE_SHARE:
            if motion_free(space, points[i - 1], points[i + 1], scratch):
                points[i : n - 1] = points[i + 1 : n].copy()
                n -= 1
        else:
            _move(space, points, i, change >= PULL_SHARE, scratch, state)
    return points[:n].copy()


@inner_kernel(inline="always")
def _free(space, path, scratch):
    for i in range(len(path) - 1):  # noqa: SIM110
        if not motion_free(space, path[i], path[i + 1], scratch):
            return False
    return True


@inner_kernel()
def _skipped(space, path, scratch):
    """The path without waypoints that straight lines can skip. After each waypoint comes the last waypoint of
    the path that a free straight line reaches."""
    out = np.empty(path.shape, np.float32)
    n = 0
    i = 0
    while True:
        out[n] = path[i]
        n += 1
        if i == len(path) - 1:
            return out[:n].copy()
        following = i + 1
        for k in range(len(path) - 1, i + 1, -1):
            if motion_free(space, path[i], path[k], scratch):
                following = k
                break
        i = following


@inner_kernel(inline="always")
def _smoothed(space, path, scratch):
    """The path after repeated subdivision: segment middles become waypoints, corners move towards them."""
    points = path
    trial = scratch.a
    dof = path.shape[1]
    for _ in range(MAX_SUBDIVISIONS):
        finer = np.empty((2 * len(points) - 1, dof), np.float32)
        for i in range(len(points)):
            finer[2 * i] = points[i]
            if i > 0:
                finer[2 * i - 1] = HALF * (points[i - 1] + points[i])
        changed = False
        for i in range(2, len(finer) - 1, 2):
            moved = np.float32(0.0)
            for j in range(dof):
                chord = HALF * (finer[i - 1, j] + finer[i + 1, j])
                trial[j] = HALF * (finer[i, j] + chord)
                moved += (trial[j] - finer[i, j]) ** 2
            if moved < MIN_MOVE * MIN_MOVE:
                continue
            if motion_free(space, finer[i - 1], trial, scratch) and motion_free(
                space, trial, finer[i + 1], scratch
            ):
                finer[i] = trial
                changed = True
        if not changed:
            return points
        points = finer
    return points


@inner_kernel(inline="always")
def _move(space, points, i, anywhere, scratch, state):
    """Moves waypoint i towards the chord of its neighbors if the path stays free and becomes shorter.
    anywhere: whether a random move is added."""
    trial = scratch.a
    before = points[i - 1]
    at = points[i]
    after = points[i + 1]
    d1 = distance(before, at)
    d2 = distance(at, after)
    share = d1 / max(d1 + d2, TINY)
    pull = random(state) ** 2
    far = MAX_RANDOM_MOVE * np.exp(-RANDOM_MOVE_LOG_RANGE * random(state)) if anywhere else np.float32(0.0)
    for j in range(points.shape[1]):
        chord = before[j] + share * (after[j] - before[j])
        aside = far * (np.float32(2.0) * random(state) - ONE)
        trial[j] = min(max(at[j] + pull * (chord - at[j]) + aside, space.lower[j]), space.upper[j])
    new1 = distance(before, trial)
    new2 = distance(trial, after)
    if (
        new1 + new2 < d1 + d2
        and min(new1, new2) >= MIN_MOVE
        and motion_free(space, before, trial, scratch)
        and motion_free(space, trial, after, scratch)
    ):
        points[i] = trial
