"""The compiled collision check of 16 configurations at once.

The check goes from coarse to fine. What a SIMD lane stands for changes with the step:

1. Frames and bounding spheres of the links: a lane is a configuration.
2. Obstacles that a link might touch in one of the configurations, from their bounding boxes: a lane is an
   obstacle.
3. Configurations in which the link's bounding sphere touches such an obstacle: a lane is a configuration.
4. Whether the link's spheres touch the obstacle, one configuration after the other: a lane is a sphere.

A group is a link with its covering spheres, which are stored in rows of 16, one sphere in each lane.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.frames import parent_of
from robotdiffuse.collision.kernels.point_grid import far_from_points, near_points, touch_points
from robotdiffuse.collision.kernels.simd import (
    W,
    absolute,
    copysign,
    first_lane,
    floor,
    gather,
    lanes_array,
    lanes_with_bit,
    load,
    load_vector,
    maximum,
    minimum,
    reduce_max,
    reduce_min,
    sqrt,
    store,
    store_vector,
)
from robotdiffuse.core.kernels import HALF, ONE, ZERO, allocation_free, kernel
from robotdiffuse.robots.frame_kernel import dot, minus

_INV_TAU = np.float32(0.15915494309189535)
_QUARTER = np.float32(0.25)
# in a table of `sphere_pair_tables.py`: how many numbers precede the cells, and the number of cells along
# each of its two joints
TABLE_HEADER = 6
TABLE_SIDE = 130
ALL_LANES = (1 << W) - 1
"""The mask of all lanes."""
# sin(2 pi u) for |u| <= 1/4: Taylor coefficients, error below 6e-8
_S1 = np.float32(6.283185307179586)
_S3 = np.float32(-41.341702240399755)
_S5 = np.float32(81.60524927607504)
_S7 = np.float32(-76.70585975306136)
_S9 = np.float32(42.058693944897655)
_S11 = np.float32(-15.094642576822984)


@allocation_free(forceinline=True)
def _sine_of_turn(u):
    """sin(2 pi u) for |u| <= 1/4."""
    v = u * u
    return u * (_S1 + v * (_S3 + v * (_S5 + v * (_S7 + v * (_S9 + v * _S11)))))


@allocation_free(forceinline=True)
def _move(frames, parent, j, offset, q):
    """Writes the frame that joint j moves, in 16 lanes: frames[j + 1] = frames[parent] @ offset @ M(q), where
    M rotates about z, or translates along z for a prismatic joint. offset: rotation, translation, and 1 for a
    prismatic joint."""
    value = load(q, j, 0)
    slide = value * offset[12]
    if offset[12] > ZERO:
        s = value * ZERO
        c = s + ONE
    else:
        turns = value * _INV_TAU
        turns = turns - floor(turns + HALF)
        turned = absolute(turns)
        c = _sine_of_turn(_QUARTER - turned)
        s = copysign(_sine_of_turn(_QUARTER - absolute(turned - _QUARTER)), turns)
    for k in range(3):
        row = load_vector(frames, parent, 3 * k)
        x = dot(row, offset[::3])
        y = dot(row, offset[1::3])
        z = dot(row, offset[2::3])
        store_vector(frames, j + 1, 3 * k, (x * c + y * s, y * c - x * s, z))
        store(frames, j + 1, 9 + k, dot(row, offset[9:]) + load(frames, parent, 9 + k) + z * slide)


@allocation_free(forceinline=True)
def centers_of(frames, f, spheres, s):
    """Positions of the center of sphere s, fixed to frame f, in 16 lanes."""
    center = spheres[s]
    return (
        dot(load_vector(frames, f, 0), center) + load(frames, f, 9),
        dot(load_vector(frames, f, 3), center) + load(frames, f, 10),
        dot(load_vector(frames, f, 6), center) + load(frames, f, 11),
    )


@allocation_free(forceinline=True)
def place_frames(robot, q, frames, centers):
    """Writes the frames of 16 configurations q[dof, 16], and the centers of all groups' bounding spheres."""
    for j in range(len(robot.offsets)):
        _move(frames, parent_of(robot.parents, j), j, robot.offsets[j], q)
    for g in range(len(robot.frame)):
        store_vector(centers, g, 0, centers_of(frames, robot.frame[g], robot.bounds, g))


@allocation_free(forceinline=True)
def in_axes(solid, v):
    """A vector in the axes of a solid, a row of `SceneArrays.solids`."""
    return dot(solid[3:], v), dot(solid[6:], v), dot(solid[9:], v)


class Workspace(NamedTuple):
    """Scratch memory of `block_hits`, which itself allocates nothing."""

    frames: np.ndarray
    """[dof + 1, 12 * W]"""
    centers: np.ndarray
    """[groups, 3 * W] centers of the bounding spheres."""
    row: np.ndarray
    """[1, 3 * W] positions of a row of spheres."""


@kernel()
def make_workspace(robot):
    """Scratch memory for one thread."""
    frames = lanes_array(len(robot.offsets) + 1, 12)
    for k in (0, 4, 8):
        frames[0, k * W : (k + 1) * W] = 1.0
    return Workspace(frames, lanes_array(len(robot.frame), 3), lanes_array(1, 3))


@allocation_free(forceinline=True)
def _touching(centers, radius, solid):
    """Mask of the lanes with a sphere that touches an obstacle, a row of `SceneArrays.solids`. Entries 12 to
    14 of the row are the half edges (of a cylinder: radius, radius, half height), entry 15 is the radius that
    is added, and entry 16 is 1 for a cylinder."""
    u, v, w = in_axes(solid, minus(centers, solid))
    w = maximum(absolute(w) - solid[14], ZERO)
    reach = radius + solid[15]
    if solid[16] > ZERO:
        r = maximum(sqrt(u * u + v * v) - solid[12], ZERO)
        return r * r + w * w < reach * reach
    u = maximum(absolute(u) - solid[12], ZERO)
    v = maximum(absolute(v) - solid[13], ZERO)
    return u * u + v * v + w * w < reach * reach


@allocation_free(forceinline=True)
def placed(frame, p):
    """Position in the base frame of point p of a frame (12 numbers); p may be coordinates of 16 points."""
    return dot(frame, p) + frame[9], dot(frame[3:], p) + frame[10], dot(frame[6:], p) + frame[11]


@allocation_free(forceinline=True)
def _place_row(robot, row, frames, f, i):
    """Positions of a row of spheres in configuration (lane) i."""
    return placed(frames[f, i::W], load_vector(robot.rows, row, 0))


@allocation_free(forceinline=True)
def _touching_group(robot, g, frames, near, padding, scene, k, stop_at_first):
    """Mask of the lanes among `near` in which group g touches obstacle k, or a point of the scene if k is
    negative."""
    hits = 0
    f = robot.frame[g]
    first = robot.first_row[g]
    last = robot.first_row[g + 1]
    for row in range(first, last):
        undecided = near & ~hits
        if last - first > 1:
            centers = centers_of(frames, f, robot.row_bounds, row)
            radius = robot.row_bounds[row, 3] + padding
            if k < 0:
                undecided &= near_points(centers, radius, scene)
            else:
                undecided &= _touching(centers, radius, scene.solids[k])
        while undecided:
            i = first_lane(undecided)
            undecided &= undecided - 1
            centers = _place_row(robot, row, frames, f, i)
            radii = load(robot.rows, row, 3) + padding
            if k < 0:
                touches = touch_points(centers, radii, scene)
            else:
                touches = _touching(centers, radii, scene.solids[k]) != 0
            if touches:
                hits |= 1 << i
                if stop_at_first:
                    return hits
    return hits


@allocation_free(forceinline=True)
def _touching_balls(centers, radius, others, other_radius):
    """Mask of the lanes in which two spheres touch each other."""
    d = minus(centers, others)
    reach = radius + other_radius
    return dot(d, d) < reach * reach


@allocation_free(forceinline=True)
def _touching_each_other(robot, a, b, near, stop_at_first, work):
    """Mask of the lanes among `near` in which the groups a and b touch each other."""
    hits = 0
    frames = work.frames
    bounds = robot.row_bounds
    for row in range(robot.first_row[a], robot.first_row[a + 1]):
        centers = centers_of(frames, robot.frame[a], bounds, row)
        partners = load_vector(work.centers, b, 0)
        near_row = near & ~hits & _touching_balls(centers, bounds[row, 3], partners, robot.bounds[b, 3])
        if near_row == 0:
            continue
        for other_row in range(robot.first_row[b], robot.first_row[b + 1]):
            partners = centers_of(frames, robot.frame[b], bounds, other_row)
            undecided = near_row & ~hits
            undecided &= _touching_balls(centers, bounds[row, 3], partners, bounds[other_row, 3])
            while undecided:
                i = first_lane(undecided)
                undecided &= undecided - 1
                if _rows_touch(robot, row, robot.frame[a], other_row, robot.frame[b], i, work):
                    hits |= 1 << i
                    if stop_at_first:
                        return hits
    return hits


@allocation_free(forceinline=True)
def _rows_touch(robot, row, f, other_row, other_f, i, work):
    """Whether a row of spheres of frame f touches the row `other_row` of frame `other_f` in lane i."""
    centers = _place_row(robot, row, work.frames, f, i)
    radius = load(robot.rows, row, 3)
    other_centers = work.row
    store_vector(other_centers, 0, 0, _place_row(robot, other_row, work.frames, other_f, i))
    for t in range(W):
        if _touching_balls(centers, radius + robot.rows[other_row, 3 * W + t], other_centers[0, t::W], ZERO):
            return True
    return False


@allocation_free(forceinline=True)
def near_boxes(boxes, row, low, high, reach):
    """Mask of the obstacles in a row of `SceneArrays.solid_boxes` whose boxes are within `reach` [m] of the
    box from `low` to `high`."""
    above = minus(load_vector(boxes, row, 0), high)
    below = minus(low, load_vector(boxes, row, 3))
    d = (
        maximum(maximum(above[0], below[0]), ZERO),
        maximum(maximum(above[1], below[1]), ZERO),
        maximum(maximum(above[2], below[2]), ZERO),
    )
    return dot(d, d) < reach * reach


@allocation_free(forceinline=True)
def _hits_scene(robot, scene, padding, stop_at_first, work):
    """Mask of the lanes in which the robot touches the scene."""
    hits = 0
    frames = work.frames
    for g in range(len(robot.frame)):
        if robot.frame[g] == 0:  # links that no joint moves
            continue
        # the box from `low` to `high` is around the 16 centers of the group's bounding sphere
        centers = load_vector(work.centers, g, 0)
        x, y, z = centers
        low = reduce_min(x), reduce_min(y), reduce_min(z)
        high = reduce_max(x), reduce_max(y), reduce_max(z)
        reach = robot.bounds[g, 3] + padding
        for row in range(len(scene.solid_boxes)):
            close = near_boxes(scene.solid_boxes, row, low, high, reach)
            while close:
                k = row * W + first_lane(close)
                close &= close - 1
                if len(scene.may_touch) and scene.may_touch[g, k]:  # an allowed contact
                    continue
                near = _touching(centers, reach, scene.solids[k]) & ~hits
                if near:
                    hits |= _touching_group(robot, g, frames, near, padding, scene, k, stop_at_first)
                    if stop_at_first and hits:
                        return hits
        if len(scene.points) and not far_from_points(scene, low, high, reach):
            near = near_points(centers, reach, scene) & ~hits
            if near:
                hits |= _touching_group(robot, g, frames, near, padding, scene, -1, stop_at_first)
                if stop_at_first and hits:
                    return hits
        if hits == ALL_LANES:
            return hits
    return hits


@allocation_free(forceinline=True)
def lanes_that_may_touch(robot, table, bit, q):
    """Mask of the lanes in which a pair of links may touch according to its table
    (`sphere_pair_tables.py`)."""
    row = robot.pair_tables[table]
    first = load(q, np.int32(row[0]), 0)
    second = load(q, np.int32(row[3]), 0)
    i = minimum(maximum((first - row[1]) * row[2], ZERO), np.float32(TABLE_SIDE - 1))
    j = minimum(maximum((second - row[4]) * row[5], ZERO), np.float32(TABLE_SIDE - 1))
    cells = gather(row, floor(i) * np.float32(TABLE_SIDE) + floor(j) + np.float32(TABLE_HEADER))
    return lanes_with_bit(cells, bit)


@allocation_free(forceinline=True)
def _hits_itself(robot, q, hits, stop_at_first, work):
    """`hits` plus the lanes in which a checked pair of links touches."""
    bounds = robot.bounds
    for p in range(len(robot.pairs)):
        a, b, table, bit = robot.pairs[p]
        centers = load_vector(work.centers, a, 0)
        partners = load_vector(work.centers, b, 0)
        near = _touching_balls(centers, bounds[a, 3], partners, bounds[b, 3]) & ~hits
        if table >= 0:
            near &= lanes_that_may_touch(robot, table, bit, q)
        if near:
            hits |= _touching_each_other(robot, a, b, near, stop_at_first, work)
            if stop_at_first and hits:
                return hits
    return hits


@allocation_free(inner=False)
def block_hits(robot, scene, q, padding, stop_at_first, work):
    """Mask of the configurations of q[dof, 16] that collide: bit i belongs to column i.

    `padding` [m] is added to the spheres' radii for checks against the scene. With `stop_at_first` the check
    ends at the first collision that it finds.
    """
    place_frames(robot, q, work.frames, work.centers)
    hits = _hits_scene(robot, scene, padding, stop_at_first, work)
    if hits == ALL_LANES or (stop_at_first and hits):
        return hits
    return _hits_itself(robot, q, hits, stop_at_first, work)


@allocation_free()
def take_block(q, start, block):
    """Copies the rows `start` to `start + 15` of q[n, dof] into the columns of block[dof, 16]; columns beyond
    the end of q get its last row."""
    for i in range(W):
        for j in range(len(block)):
            block[j, i] = q[min(start + i, len(q) - 1), j]


@kernel(nogil=True)
def free_many(robot, scene, q, padding):
    """Whether each row of q[n, dof] is free of collision; `padding` as in `block_hits`."""
    n = len(q)
    out = np.empty(n, np.bool_)
    work = make_workspace(robot)
    block = np.empty((q.shape[1], W), np.float32)
    for start in range(0, n, W):
        take_block(q, start, block)
        hits = block_hits(robot, scene, block, padding, False, work)
        for i in range(min(W, n - start)):
            out[start + i] = not hits >> i & 1
    return out
