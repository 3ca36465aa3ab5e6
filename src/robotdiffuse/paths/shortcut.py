"""Shortcuts: R. Geraerts and M. Overmars, "Creating high-quality paths for motion planning", IJRR 2007."""

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.compiled import allocation_free, random
from robotdiffuse.collision.kernels.lanes import W, make_workspace
from robotdiffuse.collision.kernels.motions import distance, motion_free, path_length

_ONE = np.float32(1.0)


@njit(cache=True, nogil=True)
def shortcut(space, path, tries, state):
    """A shorter path: straight lines between two places of the path wherever they are free.

    First waypoints that can be skipped are; then `tries` random shortcuts between places on different
    segments, each followed by the same length-reducing move of a waypoint into the chord of its neighbours.
    """
    dof = path.shape[1]
    capacity = len(path) + tries + 2
    points = np.empty((capacity, dof), np.float32)
    work, block = make_workspace(space.robot, space.scene), np.empty((dof, W), np.float32)
    a, b = np.empty(dof, np.float32), np.empty(dof, np.float32)
    n = _skip(space, path, points, block, work)
    for attempt in range(tries):
        if n <= 2:
            break
        if attempt % 2 == 1:
            _pull_in(space, points, n, a, block, work, state)
            continue
        total = path_length(points[:n])
        s, t = random(state) * total, random(state) * total
        if t < s:
            s, t = t, s
        i = _place_at(points, n, s, a)
        k = _place_at(points, n, t, b)
        # the remnants of the cut segments are checked anew: their checks fall elsewhere than before
        if (
            i == k
            or not motion_free(space, a, b, block, work)
            or not motion_free(space, points[i], a, block, work)
            or not motion_free(space, b, points[k + 1], block, work)
        ):
            continue
        # keep points[..i], a, b, points[k + 1..]
        removed = k - i
        shift = 2 - removed
        if n + shift > capacity:
            continue
        if shift > 0:
            for m in range(n - 1, k, -1):
                points[m + shift] = points[m]
        elif shift < 0:
            for m in range(k + 1, n):
                points[m + shift] = points[m]
        points[i + 1], points[i + 2] = a, b
        n += shift
    out = np.empty((n, dof), np.float32)
    n = _skip(space, points[:n], out, block, work)
    return out[:n].copy()


@njit(cache=True)
def _skip(space, path, out, block, work):
    """Copies the path less the waypoints that straight lines can skip, farthest first; returns how many."""
    n, i = 0, 0
    while True:
        out[n] = path[i]
        n += 1
        if i == len(path) - 1:
            return n
        following = i + 1
        for k in range(len(path) - 1, i + 1, -1):
            if motion_free(space, path[i], path[k], block, work):
                following = k
                break
        i = following


@allocation_free()
def _place_at(points, n, length, out):
    """Writes the place at a length along the path; returns the index of its segment."""
    for i in range(n - 1):
        d = distance(points[i], points[i + 1])
        if length <= d or i == n - 2:
            share = min(length / max(d, np.float32(1e-9)), _ONE)
            for j in range(points.shape[1]):
                out[j] = points[i, j] + share * (points[i + 1, j] - points[i, j])
            return i
        length -= d
    return 0


@njit(cache=True)
def _pull_in(space, points, n, trial, block, work, state):
    """Moves a random inner waypoint towards the chord of its neighbours as far as stays free (halving)."""
    i = 1 + int(random(state) * np.float32(n - 2))
    i = min(i, n - 2)
    before, after = points[i - 1], points[i + 1]
    d1, d2 = distance(before, points[i]), distance(points[i], after)
    share = d1 / max(d1 + d2, np.float32(1e-9))
    pull = np.float32(0.5) + np.float32(0.5) * random(state)
    for _ in range(4):
        for j in range(points.shape[1]):
            chord = before[j] + share * (after[j] - before[j])
            trial[j] = points[i, j] + pull * (chord - points[i, j])
        if motion_free(space, before, trial, block, work) and motion_free(space, trial, after, block, work):
            points[i] = trial
            return
        pull *= np.float32(0.4)
