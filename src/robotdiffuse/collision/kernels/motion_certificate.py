"""The compiled part of the motion certificate; see `collision/motions.py`.

A check is a link against the scene, or a pair of links. A piece of a motion is settled for a check when the
lower bound of the clearance along the piece is at least `tightness` times the smallest clearance measured so
far; the scene and the pairs of links each have their own smallest clearance. Bounds come from the covering
spheres, and from the convex meshes where the spheres are too coarse.

Let q be the middle of a piece and dq half of the joint motion from its start to its end. Each configuration
of the piece is q + d with |d_j| <= D_j, and there is a t in [-1, 1] with |d_j - t dq_j| <= e_j for all j. On
a straight line e is zero. The second derivative of a point's position p with respect to q_j and q_k, j <= k,
is at most L_k, the largest distance of the point from the axis of joint k (1 if the joint slides), so

    p(q + d) = p(q) + t v + r,   v = J(q) dq,   |r| <= sum_k L_k (e_k + D_k (D_k / 2 + sum_{j<k} D_j)).

For two links on one chain, motion is measured relative to the link nearer to the base, so only the joints
between the links contribute. For two links on different arms, motion is measured relative to the frame where
the arms part, and the remainders r of both links add up.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels import convex_bounds as meshes
from robotdiffuse.collision.kernels.lane_clearance import (
    group_along,
    make_clearance_workspace,
    pair_along,
    place_motions,
)
from robotdiffuse.collision.kernels.lane_collision import W
from robotdiffuse.collision.kernels.motion_pieces import Pieces, configuration, split
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.robots.frame_kernel import ball_gap

CLEARANCE_CAP = 1.0
"""Larger clearances are capped at this value [m]."""
FLOAT32_SLACK = 1e-5
"""Upper bound of the rounding error in the clearances of the float32 kernels [m]."""
CONVEX_PARTS_BELOW = 0.01
"""If the clearance of the spheres is below this [m], the convex meshes are used before a piece is split
further. The spheres stick out of the meshes by about as much."""
COAL_BELOW = 0.002
"""If the clearance of the spheres is below this [m], Coal computes distances to surfaces and point clouds
before a piece is split further. Above it, splitting is tried first, since a distance by Coal takes fifty
times as long."""
MAX_SPLIT = 4
"""A piece is split into at most this many parts at a time."""
# values of `Checks.kind`
SCENE = 0
PAIR = 1


class Arm(NamedTuple):
    """The robot."""

    spheres: tuple
    """RobotArrays"""
    hulls: tuple
    """`convex_bounds.Hulls`"""
    offsets: np.ndarray
    """[dof, 4, 4] `Robot.frame_offsets`"""
    parents: np.ndarray | None
    """[dof] `Robot.parents`; None for a chain."""
    slides: np.ndarray
    """[dof] whether the joint is prismatic."""


class Checks(NamedTuple):
    """The checks; checks against the scene come first."""

    kind: np.ndarray
    """[checks] SCENE or PAIR."""
    sphere_index: np.ndarray
    """[checks] index in RobotArrays of the link's group of spheres, or of the pair of groups; -1 without
    spheres."""
    parts: np.ndarray
    """[checks, 4] index range of the link's convex parts, then of the other link's parts. In a pair, the link
    further from the base comes first."""
    base: np.ndarray
    """[checks] the frame of the other body: frame 0 for the scene, else the frame of the link nearer to the
    base."""
    common: np.ndarray
    """[checks] the frame relative to which motion is measured: `base`, or the frame where two arms part."""
    second_arm: np.ndarray
    """[checks] for links on two arms, the first joint of the second arm; else 0."""
    motion_radii: np.ndarray
    """[checks, dof] bound on the motion of any point of the link, or of either link of a pair, per unit of
    joint motion, relative to `common`."""
    surfaces_below: np.ndarray
    """[checks] for grazing links (`Robot.grazing`), distance between their convex parts up to which Coal
    measures their mesh surfaces [m]; else 0."""


class Round(NamedTuple):
    """Undecided pieces with the bounds of each check."""

    pieces: Pieces
    clearance: np.ndarray
    """[n, checks] lower bounds of the clearance in the middle of each piece [m]; infinite where settled."""
    lower: np.ndarray
    """[n, checks] lower bounds of the clearance along each piece [m]."""
    rest: np.ndarray
    """[n, checks] the bound on the remainder |r|, already subtracted in `lower` [m]."""
    travel: np.ndarray
    """[n, checks] where only Coal can decide: bound on how far the link moves from the middle of the piece to
    either end [m]; negative elsewhere."""


@inner_kernel()
def _spread(motion, start, stop, spread):
    """Writes q, dq, e and D (`max_offset`) of the piece from start to stop, as defined at the top of this
    file, into the first rows of spread[5, dof]; the last row is scratch memory."""
    q, dq, e, max_offset, scratch = spread
    # first the ends of the piece (the start is in `dq`, the end in `scratch`), then the waypoints between
    dof = len(q)
    configuration(motion, 0.5 * (start + stop), q)
    configuration(motion, start, dq)
    configuration(motion, stop, scratch)
    square = 0.0
    for j in range(dof):
        before = dq[j] - q[j]
        after = scratch[j] - q[j]
        dq[j] = 0.5 * (after - before)
        e[j] = 0.5 * abs(after + before)
        max_offset[j] = max(abs(before), abs(after))
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
            max_offset[j] = max(max_offset[j], abs(d))
            e[j] = max(e[j], abs(d - t * dq[j]))


@inner_kernel(inline="always")
def _remainder(radii, second_arm, e, max_offset):
    """The bound on |r| at the top of this file [m]."""
    total = 0.0
    before = 0.0
    for k in range(len(radii)):
        if k == second_arm:
            before = 0.0
        if radii[k] > 0:
            total += radii[k] * (e[k] + max_offset[k] * (0.5 * max_offset[k] + before))
            before += max_offset[k]
    return total


@kernel()
def bound_by_spheres(arm, scene, motion, checks, pieces, best, work):
    """Bounds of the pieces from the covering spheres. Lowers best[kind], the smallest clearance measured."""
    n, count = pieces.undecided.shape
    dof = motion.q.shape[1]
    clearance = np.full((n, count), np.inf)
    lower = np.full((n, count), np.inf)
    rest = np.zeros((n, count))
    block = np.empty((dof, W), np.float32)
    moves = np.empty((dof, W), np.float32)
    spread = np.empty((5, dof))
    q, dq, e, max_offset, _ = spread
    for first in range(0, n, W):
        last = min(first + W, n)
        for i in range(W):
            row = first + i
            if row < n:
                _spread(motion, pieces.start[row], pieces.stop[row], spread)
                for c in range(count):
                    if pieces.undecided[row, c]:
                        rest[row, c] = _remainder(checks.motion_radii[c], checks.second_arm[c], e, max_offset)
            for j in range(dof):
                block[j, i] = q[j]
                moves[j, i] = dq[j]
        place_motions(arm.spheres, block, moves, work)
        for c in range(count - 1, -1, -1):
            undecided_count = 0
            kind = checks.kind[c]
            index = checks.sphere_index[c]
            for i in range(W):
                row = first + i
                work.need[0, i] = -1.0
                if row < n and pieces.undecided[row, c]:
                    undecided_count += 1
                    work.need[0, i] = best[kind] + rest[row, c] + FLOAT32_SLACK
            if undecided_count == 0:
                continue
            if index >= 0:
                if kind == SCENE:
                    group_along(arm.spheres, scene, index, True, work)
                else:
                    pair_along(arm.spheres, index, True, work)
            for row in range(first, last):
                if not pieces.undecided[row, c]:
                    continue
                if index < 0:
                    clearance[row, c] = lower[row, c] = -np.inf
                    continue
                clearance[row, c] = work.clearance[0, row - first] - FLOAT32_SLACK
                lower[row, c] = work.lower[0, row - first] - rest[row, c] - FLOAT32_SLACK
                if clearance[row, c] > CONVEX_PARTS_BELOW:
                    best[kind] = min(best[kind], clearance[row, c])
    return Round(pieces, clearance, lower, rest, np.full((n, count), -1.0))


@inner_kernel()
def _is_open(bounds, checks, best, tightness, row, c):
    """Whether a check of a piece is not settled by its lower bound."""
    required = tightness * best[checks.kind[c]]
    return bounds.pieces.undecided[row, c] and bounds.lower[row, c] < required


@kernel()
def bound_by_convex_parts(arm, solids, motion, checks, bounds, best, tightness, contact, posture):
    """Improves `bounds` by the convex meshes where the spheres are too coarse. Lowers best[kind].

    Returns the number of checks that only Coal can decide; `bounds.travel` marks them.
    """
    n, count = bounds.clearance.shape
    spread = np.empty((5, motion.q.shape[1]))
    open_count = 0
    for row in range(n):
        is_posed = False
        for c in range(count):
            if bounds.clearance[row, c] > CONVEX_PARTS_BELOW or not _is_open(
                bounds, checks, best, tightness, row, c
            ):
                continue
            if not is_posed:
                _spread(motion, bounds.pieces.start[row], bounds.pieces.stop[row], spread)
                meshes.pose(arm.offsets, arm.parents, arm.slides, spread[0], spread[1], posture)
                is_posed = True
            rest = bounds.rest[row, c]
            kind = checks.kind[c]
            sphere_clearance = bounds.clearance[row, c]
            clearance, lower, best[kind], unresolved, touching = _bound_by_planes(
                arm.hulls, solids, checks, c, rest, best[kind], tightness, contact, posture
            )
            if not unresolved:
                bounds.clearance[row, c] = max(clearance, sphere_clearance)
                bounds.lower[row, c] = max(lower, bounds.lower[row, c])
            if unresolved and not touching and sphere_clearance > COAL_BELOW:
                best[kind] = min(best[kind], sphere_clearance)
            elif touching or unresolved:
                part_travel = 0.0
                for p in range(checks.parts[c, 0], checks.parts[c, 1]):
                    part_travel = max(part_travel, meshes.part_travel(arm.hulls, p, checks.base[c], posture))
                bounds.travel[row, c] = part_travel + rest
                open_count += 1
    return open_count


@inner_kernel(inline="always")
def _bound_by_planes(hulls, solids, checks, c, rest, best, tightness, contact, posture):
    """Bounds of one check of a piece from separating planes.

    Returns:
        A lower bound of the clearance in the middle of the piece [m].
        A lower bound of the clearance along the piece [m].
        `best`, or the smaller clearance that was measured [m].
        Whether a surface or point cloud is too near; only a box around it is known here.
        Whether bodies touch or nearly touch.
    """
    against_scene = checks.kind[c] == SCENE
    base = checks.base[c]
    common = checks.common[c]
    parts = len(hulls.frame)
    clearance = CLEARANCE_CAP
    lower = CLEARANCE_CAP
    unresolved = False
    touching = False
    partners = range(len(solids.disc)) if against_scene else range(checks.parts[c, 2], checks.parts[c, 3])
    for p in range(checks.parts[c, 0], checks.parts[c, 1]):
        part_travel = meshes.part_travel(hulls, p, base, posture)
        for o in partners:
            if against_scene and len(solids.may_touch) and solids.may_touch[c, o]:
                continue
            if against_scene:
                middle = meshes.ball_to_solid(hulls, p, solids, o, posture)
            else:
                frame, other_frame = posture.frames[hulls.frame[p]], posture.frames[hulls.frame[o]]
                middle = ball_gap(frame, hulls.balls[p], other_frame, hulls.balls[o])
            along = middle - part_travel
            if against_scene and solids.is_bound[o]:
                if along - rest < tightness * best:
                    unresolved = True
                    continue
            elif along - rest < best:
                solid, slot = (o, parts + o) if against_scene else (-1 - o, o)
                middle, along, measured = meshes.best_plane(
                    hulls, p, solids, solid, common, tightness * best + rest, posture.planes[p, slot], posture
                )
                if measured and middle <= max(contact, checks.surfaces_below[c]):
                    touching = True
                elif measured:
                    best = min(best, middle)
            clearance = min(clearance, middle)
            lower = min(lower, along - rest)
    return clearance, lower, best, unresolved, touching


@kernel()
def settle(checks, bounds, best, certified, tightness):
    """Settles the checks with sufficient bounds, and splits the pieces that have undecided checks. Lowers
    certified[kind]."""
    pieces = bounds.pieces
    n, count = bounds.clearance.shape
    parts = np.zeros(n, np.int64)
    total = np.int64(0)
    for row in range(n):
        for c in range(count):
            if not pieces.undecided[row, c]:
                continue
            kind = checks.kind[c]
            required = tightness * best[kind]
            lower = bounds.lower[row, c]
            if lower >= required:
                pieces.undecided[row, c] = False
                certified[kind] = min(certified[kind], lower)
                continue
            # the loss of clearance along a piece is proportional to its length, the remainder to its square;
            # the piece is split into the fewest parts for which loss plus remainder is probably at most
            # `spare`
            rest = bounds.rest[row, c]
            spare = bounds.clearance[row, c] - required
            lost = bounds.clearance[row, c] - lower - rest
            k = 2
            while k < MAX_SPLIT and not lost / k + rest / (k * k) <= spare:
                k += 1
            parts[row] = max(parts[row], k)
        total += parts[row]
    return split(pieces, parts, total)


@kernel(nogil=True)
def rounds(arm, scene, solids, motion, checks, pieces, best, certified, tightness, contact):
    """Repeats bounding, settling and splitting until a check needs Coal, or no piece is left.

    Lowers best[kind] and certified[kind]. Returns the bounds of the last round, before settling; `travel` in
    them marks the checks that Coal has to decide.
    """
    work = make_clearance_workspace(arm.spheres, len(scene.solids))
    posture = meshes.make_posture(arm.hulls, solids, motion.q.shape[1])
    while True:
        bounds = bound_by_spheres(arm, scene, motion, checks, pieces, best, work)
        open_count = bound_by_convex_parts(
            arm, solids, motion, checks, bounds, best, tightness, contact, posture
        )
        if open_count or len(bounds.travel) == 0:
            return bounds
        pieces = settle(checks, bounds, best, certified, tightness)
