"""The compiled part of the validator's certificate; see `collision/motions.py`.

A check is a link against the scene, or a pair of links. A piece of a motion is settled for a check when the
lower bound of its clearance along the piece leaves a margin: `tightness` of the least clearance measured of
its kind. Bounds come from the covering spheres, and from the convex meshes where those are too coarse.

A piece reaches from its middle q to both ends. Any of its configurations is q + d with |d_j| <= D_j, and for
some t in [-1, 1] |d_j - t dq_j| <= e_j; on a straight line e is zero. Twice differentiating a point's place
p by joints j <= k gives at most the distance L_k of the point from the axis of joint k, so

    p(q + d) = p(q) + t v + r,   v = J(q) dq,   |r| <= sum_k L_k (e_k + D_k (D_k / 2 + sum_{j<k} D_j)).

Of two links on one chain, the further is seen from the nearer, so only the joints between them count. Of two
on different arms, both are seen from where the arms part: the remainders of both add up.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels import convex_bounds as meshes
from robotdiffuse.collision.kernels.lane_collision import W
from robotdiffuse.collision.kernels.swept_spheres import (
    group_along,
    make_swept_spheres,
    pair_along,
    place_motions,
)

CLEARANCE_CAP = 1.0
"""Clearances are not looked for beyond this [m]."""
FLOAT32_SLACK = 1e-5
"""What rounding may add to the clearances of the compiled kernel [m]."""
CONVEX_PARTS_BELOW = 0.01
"""Sphere clearance [m] below which the convex meshes are looked at rather than the piece split further: the
spheres stick out by about as much."""
COAL_BELOW = 0.002
"""The same for distances that only Coal knows, which take fifty times as long [m]."""
MAX_SPLIT = 4
"""A piece is split into at most this many at a time."""
STRAIGHT_COSINE = 0.995
"""First pieces end at waypoints where the cosine of the turn is below this."""
SCENE, PAIR = 0, 1


class Arm(NamedTuple):
    """The robot."""

    spheres: tuple
    """RobotArrays"""
    hulls: tuple
    offsets: np.ndarray
    """[dof, 4, 4] `Robot.frame_offsets`"""
    parents: np.ndarray | None
    """[dof] `Robot.parents`; None of a chain."""
    slides: np.ndarray
    """[dof] whether the joint is prismatic."""


class Checks(NamedTuple):
    """What is checked, those against the scene first."""

    kind: np.ndarray
    """[checks] SCENE or PAIR."""
    where: np.ndarray
    """[checks] the group of spheres, or the pair of groups; -1 where the spheres do not know it."""
    parts: np.ndarray
    """[checks, 4] from which part of the hulls on, up to which; and of the link that is further from the base
    in a pair: those of the nearer one."""
    base: np.ndarray
    """[checks] the frame of what the link is checked against: the base, or that of the nearer link."""
    common: np.ndarray
    """[checks] the frame that motion is seen from: `base`, or where the arms of two links part."""
    second: np.ndarray
    """[checks] of links on two arms, the first joint of the second arm; else 0."""
    motion_radii: np.ndarray
    """[checks, dof] motion bound of the link, or of either of two, seen from there, per unit of joint
    motion."""


class Motion(NamedTuple):
    """Straight lines through waypoints."""

    q: np.ndarray
    """[n, dof]"""
    way: np.ndarray
    """[n] motion bound of the arm up to each waypoint [m]; places on the motion are given by it."""


class Pieces(NamedTuple):
    """Pieces of a motion in order."""

    start: np.ndarray
    stop: np.ndarray
    undecided: np.ndarray
    """[n, checks]"""


class Round(NamedTuple):
    """Pieces that are left open, with what is known of each check."""

    pieces: Pieces
    clearance: np.ndarray
    """[n, checks] lower bounds in the middles [m]; infinite where settled."""
    lower: np.ndarray
    """[n, checks] lower bounds along the pieces [m]."""
    rest: np.ndarray
    """[n, checks] what the remainder takes away of them [m]."""
    travel: np.ndarray
    """[n, checks] where only Coal can tell: how far the link moves from the middle to an end at most [m];
    else negative."""


@njit(cache=True)
def travel_along(q, motion_radii):
    """[n] motion bounds from the first waypoint of q[n, dof] to each, of the link that moves most."""
    way = np.zeros(len(q))
    for i in range(1, len(q)):
        most = 0.0
        for c in range(len(motion_radii)):
            total = 0.0
            for j in range(q.shape[1]):
                total += motion_radii[c, j] * abs(q[i, j] - q[i - 1, j])
            most = max(most, total)
        way[i] = way[i - 1] + most
    return way


@njit(cache=True)
def segment_at(way, at):
    """The last waypoint that is not beyond a place, and the share of the way from there to the next."""
    low = min(max(np.searchsorted(way, at, side="right") - 1, 0), max(len(way) - 2, 0))
    if low + 1 >= len(way) or way[low + 1] <= way[low]:
        return low, 0.0
    return low, min((at - way[low]) / (way[low + 1] - way[low]), 1.0)


@njit(cache=True)
def configuration(motion, at, out):
    """The configuration at a place, to out[dof]."""
    low, share = segment_at(motion.travel, at)
    high = min(low + 1, len(motion.travel) - 1)
    for j in range(len(out)):
        out[j] = motion.q[low, j] + share * (motion.q[high, j] - motion.q[low, j])


@njit(cache=True)
def _cut(ends, start, stop, travel):
    """Appends where the parts of a stretch, which are equal and about `travel` long, end."""
    count = max(int(np.ceil((stop - start) / travel)), 1)
    for k in range(1, count):
        ends.append(start + (stop - start) * (k / count))
    ends.append(stop)


@njit(cache=True)
def first_pieces(motion, checks, travel):
    """Pieces whose motion bounds are about `travel` [m] and that turn little, after one of no length at the
    start."""
    q, way = motion
    n, dof = q.shape
    ends = [0.0]
    last, before = 0.0, -1
    for i in range(1, n):
        if way[i] <= way[i - 1]:
            continue
        dot, a, b = 1.0, 1.0, 1.0
        if before >= 0:
            dot, a, b = 0.0, 0.0, 0.0
            for j in range(dof):
                u, v = q[before + 1, j] - q[before, j], q[i, j] - q[i - 1, j]
                dot, a, b = dot + u * v, a + u * u, b + v * v
        if dot < STRAIGHT_COSINE * np.sqrt(a * b):
            _cut(ends, last, way[i - 1], travel)
            last = way[i - 1]
        before = i - 1
    if way[n - 1] > last:
        _cut(ends, last, way[n - 1], travel)
    start, stop = np.empty(len(ends)), np.empty(len(ends))
    for k in range(len(ends)):
        start[k], stop[k] = ends[max(k - 1, 0)], ends[k]
    return Pieces(start, stop, np.ones((len(ends), len(checks.kind)), np.bool_))


@njit(cache=True)
def _spread(motion, start, stop, q, dq, e, most, scratch):
    """Fills q, dq, e and D (`most`) of the head of this file for a piece."""
    dof = len(q)
    configuration(motion, 0.5 * (start + stop), q)
    configuration(motion, start, dq)
    configuration(motion, stop, scratch)
    square = 0.0
    for j in range(dof):
        before, after = dq[j] - q[j], scratch[j] - q[j]
        dq[j] = 0.5 * (after - before)
        e[j] = 0.5 * abs(after + before)
        most[j] = max(abs(before), abs(after))
        square += dq[j] * dq[j]
    first = np.searchsorted(motion.travel, start, side="right")
    for i in range(first, len(motion.travel)):
        if motion.travel[i] >= stop:
            break
        t = 0.0
        for j in range(dof):
            t += (motion.q[i, j] - q[j]) * dq[j]
        t = min(max(t / max(square, 1e-300), -1.0), 1.0)
        for j in range(dof):
            d = motion.q[i, j] - q[j]
            most[j] = max(most[j], abs(d))
            e[j] = max(e[j], abs(d - t * dq[j]))


@njit(cache=True)
def _remainder(lever, second, e, most):
    total, before = 0.0, 0.0
    for k in range(len(lever)):
        if k == second:
            before = 0.0
        if lever[k] > 0:
            total += lever[k] * (e[k] + most[k] * (0.5 * most[k] + before))
            before += most[k]
    return total


@njit(cache=True)
def bound_by_spheres(arm, scene, motion, checks, pieces, best, work):
    """What the spheres say of the pieces; lowers best[2]."""
    n, count = pieces.undecided.shape
    dof = motion.q.shape[1]
    clearance, lower = np.full((n, count), np.inf), np.full((n, count), np.inf)
    rest = np.zeros((n, count))
    block, moves = np.empty((dof, W), np.float32), np.empty((dof, W), np.float32)
    q, dq, e, most, scratch = np.empty(dof), np.empty(dof), np.empty(dof), np.empty(dof), np.empty(dof)
    for first in range(0, n, W):
        last = min(first + W, n)
        for i in range(W):
            row = first + i
            if row < n:
                _spread(motion, pieces.start[row], pieces.stop[row], q, dq, e, most, scratch)
                for c in range(count):
                    if pieces.undecided[row, c]:
                        rest[row, c] = _remainder(checks.motion_radii[c], checks.second[c], e, most)
            for j in range(dof):
                block[j, i], moves[j, i] = q[j], dq[j]
        place_motions(arm.spheres, block, moves, work)
        for c in range(count - 1, -1, -1):
            open_ones, kind = 0, checks.kind[c]
            for i in range(W):
                row = first + i
                work.need[i] = -1.0
                if row < n and pieces.undecided[row, c]:
                    open_ones += 1
                    work.need[i] = best[kind] + rest[row, c] + FLOAT32_SLACK
            if open_ones == 0:
                continue
            if checks.where[c] >= 0:
                if kind == SCENE:
                    group_along(arm.spheres, scene, checks.where[c], work)
                else:
                    pair_along(arm.spheres, checks.where[c], work)
            for row in range(first, last):
                if not pieces.undecided[row, c]:
                    continue
                if checks.where[c] < 0:
                    clearance[row, c] = lower[row, c] = -np.inf
                    continue
                clearance[row, c] = work.clearance[0, row - first] - FLOAT32_SLACK
                lower[row, c] = work.lower[0, row - first] - rest[row, c] - FLOAT32_SLACK
                if clearance[row, c] > CONVEX_PARTS_BELOW:
                    best[kind] = min(best[kind], clearance[row, c])
    return Round(pieces, clearance, lower, rest, np.full((n, count), -1.0))


@njit(cache=True)
def _is_open(found, checks, best, tightness, row, c):
    least = tightness * best[checks.kind[c]]
    return found.pieces.undecided[row, c] and found.lower[row, c] < least


@njit(cache=True)
def bound_by_convex_parts(arm, solids, motion, checks, found, best, tightness, contact, posture):
    """Better bounds, from the convex meshes, where those of the spheres are too coarse; lowers best[2].
    Returns how many checks are left to Coal."""
    n, count = found.clearance.shape
    dof = motion.q.shape[1]
    q, dq, e, most, scratch = np.empty(dof), np.empty(dof), np.empty(dof), np.empty(dof), np.empty(dof)
    asked = 0
    for row in range(n):
        posed = False
        for c in range(count):
            if found.clearance[row, c] > CONVEX_PARTS_BELOW or not _is_open(
                found, checks, best, tightness, row, c
            ):
                continue
            if not posed:
                _spread(motion, found.pieces.start[row], found.pieces.stop[row], q, dq, e, most, scratch)
                meshes.pose(arm.offsets, arm.parents, arm.slides, q, dq, posture)
                posed = True
            rest, kind, coarser = found.rest[row, c], checks.kind[c], found.clearance[row, c]
            clearance, lower, best[kind], coarse, touching = _parted(
                arm.hulls, solids, checks, c, rest, best[kind], tightness, contact, posture
            )
            if not coarse:
                found.clearance[row, c] = max(clearance, coarser)
                found.lower[row, c] = max(lower, found.lower[row, c])
            if coarse and not touching and coarser > COAL_BELOW:
                best[kind] = min(best[kind], coarser)
            elif touching or coarse:
                speed = 0.0
                for p in range(checks.parts[c, 0], checks.parts[c, 1]):
                    speed = max(speed, meshes.part_speed(arm.hulls, p, checks.base[c], posture))
                found.travel[row, c] = speed + rest
                asked += 1
    return asked


@njit(cache=True)
def _parted(hulls, solids, checks, c, rest, best, tightness, contact, posture):
    """Of a check and a piece: lower bounds of the clearance in the middle and along the piece, `best` or less
    if less was measured, whether something is known by its bounds alone that are too near, and whether bodies
    touch or nearly."""
    against_scene = checks.kind[c] == SCENE
    base, common, parts = checks.base[c], checks.common[c], len(hulls.frame)
    clearance, lower, coarse, touching = CLEARANCE_CAP, CLEARANCE_CAP, False, False
    others = range(len(solids.disc)) if against_scene else range(checks.parts[c, 2], checks.parts[c, 3])
    for p in range(checks.parts[c, 0], checks.parts[c, 1]):
        speed = meshes.part_speed(hulls, p, base, posture)
        for o in others:
            if against_scene:
                middle = meshes.ball_to_solid(hulls, p, solids, o, posture)
            else:
                middle = meshes.ball_to_ball(hulls, p, o, posture)
            along = middle - speed
            if against_scene and solids.bounds[o]:
                if along - rest < tightness * best:
                    coarse = True
                    continue
            elif along - rest < best:
                other, slot = (o, parts + o) if against_scene else (-1 - o, o)
                middle, along, measured = meshes.best_plane(
                    hulls, p, solids, other, common, tightness * best + rest, posture.planes[p, slot], posture
                )
                if measured and middle <= contact:
                    touching = True
                elif measured:
                    best = min(best, middle)
            clearance, lower = min(clearance, middle), min(lower, along - rest)
    return clearance, lower, best, coarse, touching


@njit(cache=True)
def settle(checks, found, best, certified, tightness):
    """Settle what the bounds of a round allow and split the rest; lowers certified[2]."""
    pieces = found.pieces
    n, count = found.clearance.shape
    parts, total = np.zeros(n, np.int64), 0
    for row in range(n):
        for c in range(count):
            if not pieces.undecided[row, c]:
                continue
            kind = checks.kind[c]
            least, lower = tightness * best[kind], found.lower[row, c]
            if lower >= least:
                pieces.undecided[row, c] = False
                certified[kind] = min(certified[kind], lower)
                continue
            # what is lost along a piece falls with its length, the remainder with its square
            rest, spare = found.rest[row, c], found.clearance[row, c] - least
            lost, k = found.clearance[row, c] - lower - rest, 2
            while k < MAX_SPLIT and not lost / k + rest / (k * k) <= spare:
                k += 1
            parts[row] = max(parts[row], k)
        total += parts[row]
    return split(pieces, parts, total)


@njit(cache=True)
def split(pieces, parts, total):
    """Every piece in so many equal parts, `total` altogether; 0 drops it."""
    start, stop = np.empty(total), np.empty(total)
    undecided = np.empty((total, pieces.undecided.shape[1]), np.bool_)
    at = 0
    for row in range(len(parts)):
        begin, end, count = pieces.start[row], pieces.stop[row], parts[row]
        for k in range(count):
            start[at] = begin + (end - begin) * (k / count)
            stop[at] = end if k + 1 == count else begin + (end - begin) * ((k + 1) / count)
            undecided[at] = pieces.undecided[row]
            at += 1
    return Pieces(start, stop, undecided)


@njit(cache=True, nogil=True)
def rounds(arm, scene, solids, motion, checks, pieces, best, certified, tightness, contact):
    """Rounds of bounding, settling and splitting until a check needs Coal, or nothing is left.

    best[2] and certified[2], by kind, are lowered. Returns the last round, not settled, and which of its
    checks Coal is to be asked about: rows and columns, in order of the motion.
    """
    work = make_swept_spheres(arm.spheres, scene)
    posture = meshes.make_posture(arm.hulls, solids, motion.q.shape[1])
    while True:
        found = bound_by_spheres(arm, scene, motion, checks, pieces, best, work)
        asked = bound_by_convex_parts(arm, solids, motion, checks, found, best, tightness, contact, posture)
        n, count = found.clearance.shape
        if n == 0 or asked:
            rows, columns, k = np.empty(asked, np.int64), np.empty(asked, np.int64), 0
            for row in range(n):
                for c in range(count):
                    if found.travel[row, c] >= 0:
                        rows[k], columns[k] = row, c
                        k += 1
            return found, rows, columns
        pieces = settle(checks, found, best, certified, tightness)


@njit(cache=True)
def configurations(motion, places):
    """[m, dof] at the places."""
    out = np.empty((len(places), motion.q.shape[1]))
    for i in range(len(places)):
        configuration(motion, places[i], out[i])
    return out
