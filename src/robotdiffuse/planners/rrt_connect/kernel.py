"""Compiled RRT-Connect and shortcutting over the collision kernel.

RRT-Connect: J. Kuffner and S. LaValle, "RRT-Connect: An efficient approach to single-query path planning",
ICRA 2000; balanced trees as in J. Kuffner and S. LaValle, "An efficient approach to path planning using
balanced bidirectional RRT search", 2005. Shortcutting: R. Geraerts and M. Overmars, "Creating high-quality
paths for motion planning", IJRR 2007.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.compiled import allocation_free
from robotdiffuse.collision.kernels.lanes import W, block_hits, make_workspace

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
RELAXATION_SLOPE = np.float32(0.1)
"""How the padding grows with the distance from an end that is closer to the scene [m/rad]."""
RELAXATION_STEP = np.float32(0.1)
"""Near such an end the padding changes in steps of this length [rad]."""


class Space(NamedTuple):
    """What a search needs to know about the robot and the scene."""

    robot: tuple
    """RobotArrays"""
    scene: tuple
    """SceneArrays"""
    lower: np.ndarray
    upper: np.ndarray
    levers: np.ndarray
    """[dof] largest distance of any point of the arm from each joint's axis [m], 1 for prismatic joints."""
    resolution: np.float32
    """No point of the arm moves further than this between two checks [m]."""
    padding: np.float32
    """Added to the radii of the spheres towards the scene [m]."""
    near_ends: np.ndarray
    """[m, dof + 1] ends that are closer to the scene than `padding`, and the padding that they allow [m]."""


class Trees(NamedTuple):
    """Two trees, from the start and from the goals; filled in place, so that a search can go on."""

    nodes: np.ndarray
    """[2, capacity, dof]"""
    parents: np.ndarray
    """[2, capacity] -1 for roots."""
    sizes: np.ndarray
    """[2]"""


@allocation_free()
def random(state):
    """Uniform in [0, 1) from the state uint64[1] (xorshift64*, S. Vigna 2016)."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return np.float32((x * np.uint64(2685821657736338717)) >> np.uint64(40)) * np.float32(5.9604645e-08)


@allocation_free(fastmath=True)
def distance(a, b):
    total = np.float32(0.0)
    for j in range(len(a)):
        total += (a[j] - b[j]) * (a[j] - b[j])
    return np.sqrt(total)


@allocation_free()
def motion_free(space, a, b, block, work):
    """Whether the straight motion from a to b is free; b is checked, a is not.

    Each block of 16 takes configurations spread over the whole motion, so that a collision anywhere tends to
    show in the first block (the rake of W. Thomason et al., "Motions in Microseconds", ICRA 2024).
    """
    if len(space.near_ends) == 0:
        return _stretch_free(space, a, b, np.float32(0.0), _ONE, space.padding, block, work)
    length = distance(a, b)
    pieces = max(int(np.ceil(length / RELAXATION_STEP)), 1)
    half = np.float32(0.5) * length / np.float32(pieces)
    first, first_padding = 0, padding_near(space, a, b, np.float32(0.5) / np.float32(pieces), half)
    for k in range(1, pieces + 1):
        padding = np.float32(-1.0)
        if k < pieces:
            padding = padding_near(space, a, b, (np.float32(k) + np.float32(0.5)) / np.float32(pieces), half)
        if padding != first_padding:
            s, t = np.float32(first) / np.float32(pieces), np.float32(k) / np.float32(pieces)
            if not _stretch_free(space, a, b, s, t, first_padding, block, work):
                return False
            first, first_padding = k, padding
    return True


@allocation_free()
def padding_near(space, a, b, share, around):
    """The padding asked for within `around` [rad] of the place at a share of the way from a to b: near an end
    that is closer to the scene, what that end allows and RELAXATION_SLOPE more for each radian from it."""
    padding, dof = space.padding, len(a)
    for m in range(len(space.near_ends)):
        total = np.float32(0.0)
        for j in range(dof):
            d = a[j] + share * (b[j] - a[j]) - space.near_ends[m, j]
            total += d * d
        padding = min(
            padding, space.near_ends[m, dof] + RELAXATION_SLOPE * max(np.sqrt(total) - around, _ZERO)
        )
    return padding


@allocation_free()
def _stretch_free(space, a, b, s, t, padding, block, work):
    """Whether the part of the motion after the share s and up to the share t is free."""
    dof = len(a)
    travel = np.float32(0.0)
    for j in range(dof):
        travel += (t - s) * abs(b[j] - a[j]) * space.levers[j]
    blocks = max(int(np.ceil(travel / space.resolution / np.float32(W))), 1)
    step = (t - s) / np.float32(blocks * W)
    for k in range(blocks):
        for j in range(dof):
            origin, delta = a[j] + s * (b[j] - a[j]), b[j] - a[j]
            for i in range(W):
                block[j, i] = origin + np.float32(i * blocks + (blocks - k)) * step * delta
        if block_hits(space.robot, space.scene, block, padding, True, work):
            return False
    return True


@njit(cache=True, nogil=True)
def motions_free(space, path):
    """Whether each straight motion between the rows of path[n, dof] is free; ends are checked, not starts."""
    work, block = make_workspace(space.robot, space.scene), np.empty((path.shape[1], W), np.float32)
    out = np.empty(len(path) - 1, np.bool_)
    for i in range(len(path) - 1):
        out[i] = motion_free(space, path[i], path[i + 1], block, work)
    return out


@allocation_free(fastmath=True)
def _nearest(nodes, tree, size, q):
    best, where = np.float32(np.inf), 0
    dof = len(q)
    for n in range(size):
        total = np.float32(0.0)
        for j in range(dof):
            d = nodes[tree, n, j] - q[j]
            total += d * d
        if total < best:
            best, where = total, n
    return where


@njit(cache=True)
def make_trees(start, goals, capacity):
    """Trees with the start and the goals as their roots."""
    nodes = np.empty((2, capacity, len(start)), np.float32)
    parents = np.full((2, capacity), -1, np.int32)
    nodes[0, 0] = start
    for g in range(len(goals)):
        nodes[1, g] = goals[g]
    return Trees(nodes, parents, np.array([1, len(goals)], np.int32))


@njit(cache=True, nogil=True)
def search(space, trees, reach, iterations, state):
    """RRT-Connect for a number of iterations; `reach` is the longest extension [rad].

    Returns the waypoints [n, dof] from the start to a goal, with n = 0 if none was found yet. Stops early
    when a tree is full.
    """
    nodes, parents, sizes = trees
    dof = nodes.shape[2]
    work, block = make_workspace(space.robot, space.scene), np.empty((dof, W), np.float32)
    target, new = np.empty(dof, np.float32), np.empty(dof, np.float32)
    for _ in range(iterations):
        tree = 0 if sizes[0] <= sizes[1] else 1
        if sizes[tree] >= nodes.shape[1] or sizes[1 - tree] >= nodes.shape[1]:
            break
        for j in range(dof):
            target[j] = space.lower[j] + random(state) * (space.upper[j] - space.lower[j])
        near = _nearest(nodes, tree, sizes[tree], target)
        gap = distance(nodes[tree, near], target)
        share = min(reach / max(gap, np.float32(1e-6)), _ONE)
        for j in range(dof):
            new[j] = nodes[tree, near, j] + share * (target[j] - nodes[tree, near, j])
        if not motion_free(space, nodes[tree, near], new, block, work):
            continue
        here = sizes[tree]
        nodes[tree, here], parents[tree, here] = new, near
        sizes[tree] += 1
        other = 1 - tree
        near = _nearest(nodes, other, sizes[other], new)
        while sizes[other] < nodes.shape[1]:
            gap = distance(nodes[other, near], new)
            last = gap <= reach
            share = _ONE if last else reach / gap
            for j in range(dof):
                target[j] = nodes[other, near, j] + share * (new[j] - nodes[other, near, j])
            if not motion_free(space, nodes[other, near], target, block, work):
                break
            if last:
                return _join(nodes, parents, tree, here, near)
            nodes[other, sizes[other]], parents[other, sizes[other]] = target, near
            near = sizes[other]
            sizes[other] += 1
    return np.empty((0, dof), np.float32)


@njit(cache=True)
def _join(nodes, parents, tree, here, near):
    a, b = (here, near) if tree == 0 else (near, here)
    count = 0
    for side, node in ((0, a), (1, b)):
        while node >= 0:
            node = parents[side, node]
            count += 1
    path = np.empty((count, nodes.shape[2]), np.float32)
    count, node = 0, a
    while node >= 0:
        count += 1
        node = parents[0, node]
    node = a
    for i in range(count - 1, -1, -1):
        path[i] = nodes[0, node]
        node = parents[0, node]
    node = b
    while node >= 0:
        path[count] = nodes[1, node]
        count += 1
        node = parents[1, node]
    return path


@njit(cache=True)
def path_length(path):
    """Sum of the lengths of the segments [rad]."""
    total = np.float32(0.0)
    for i in range(len(path) - 1):
        total += distance(path[i], path[i + 1])
    return total


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
