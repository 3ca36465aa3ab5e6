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
    maximum,
    minimum,
    reduce_max,
    reduce_min,
    sqrt,
    store,
)
from robotdiffuse.core.kernels import allocation_free, kernel

_INV_TAU = np.float32(0.15915494309189535)
_QUARTER = np.float32(0.25)
_HALF = np.float32(0.5)
# in a table of `sphere_pair_tables.py`: how many numbers precede the cells, and the number of cells along
# each of its two joints
TABLE_HEADER = 6
TABLE_SIDE = 130
ALL_LANES = (1 << W) - 1
"""The mask of all lanes."""
_ZERO = np.float32(0.0)
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
def _turn(frames, parent, j, offset, q):
    """Writes the frame that revolute joint j moves, in 16 lanes: frames[j + 1] = frames[parent] @ offset @
    Rz(q)."""
    turns = load(q, j, 0) * _INV_TAU
    turns = turns - floor(turns + _HALF)
    turned = absolute(turns)
    c = _sine_of_turn(_QUARTER - turned)
    s = copysign(_sine_of_turn(_QUARTER - absolute(turned - _QUARTER)), turns)
    for k in range(3):
        r0 = load(frames, parent, 3 * k)
        r1 = load(frames, parent, 3 * k + 1)
        r2 = load(frames, parent, 3 * k + 2)
        x = r0 * offset[0] + r1 * offset[3] + r2 * offset[6]
        y = r0 * offset[1] + r1 * offset[4] + r2 * offset[7]
        z = r0 * offset[2] + r1 * offset[5] + r2 * offset[8]
        store(frames, j + 1, 3 * k, x * c + y * s)
        store(frames, j + 1, 3 * k + 1, y * c - x * s)
        store(frames, j + 1, 3 * k + 2, z)
        p = r0 * offset[9] + r1 * offset[10] + r2 * offset[11]
        store(frames, j + 1, 9 + k, p + load(frames, parent, 9 + k))


@allocation_free(forceinline=True)
def _slide(frames, parent, j, offset, q):
    """Writes the frame that prismatic joint j moves, in 16 lanes: frames[j + 1] = frames[parent] @ offset @
    Tz(q)."""
    for k in range(3):
        r0 = load(frames, parent, 3 * k)
        r1 = load(frames, parent, 3 * k + 1)
        r2 = load(frames, parent, 3 * k + 2)
        z = r0 * offset[2] + r1 * offset[5] + r2 * offset[8]
        store(frames, j + 1, 3 * k, r0 * offset[0] + r1 * offset[3] + r2 * offset[6])
        store(frames, j + 1, 3 * k + 1, r0 * offset[1] + r1 * offset[4] + r2 * offset[7])
        store(frames, j + 1, 3 * k + 2, z)
        p = r0 * offset[9] + r1 * offset[10] + r2 * offset[11]
        store(frames, j + 1, 9 + k, p + load(frames, parent, 9 + k) + z * load(q, j, 0))


@allocation_free(forceinline=True)
def _centers_of(frames, f, spheres, s):
    """Positions of the center of sphere s, fixed to frame f, in 16 lanes."""
    x = spheres[s, 0]
    y = spheres[s, 1]
    z = spheres[s, 2]
    return (
        load(frames, f, 0) * x + load(frames, f, 1) * y + load(frames, f, 2) * z + load(frames, f, 9),
        load(frames, f, 3) * x + load(frames, f, 4) * y + load(frames, f, 5) * z + load(frames, f, 10),
        load(frames, f, 6) * x + load(frames, f, 7) * y + load(frames, f, 8) * z + load(frames, f, 11),
    )


@allocation_free(forceinline=True)
def place(frames, f, spheres, s, positions, p):
    """Writes the positions of the center of sphere s, fixed to frame f, in 16 lanes to row p of
    `positions`."""
    x, y, z = _centers_of(frames, f, spheres, s)
    store(positions, p, 0, x)
    store(positions, p, 1, y)
    store(positions, p, 2, z)


@allocation_free(forceinline=True)
def place_frames(robot, q, frames, centers):
    """Writes the frames of 16 configurations q[dof, 16], and the centers of all groups' bounding spheres."""
    for j in range(len(robot.offsets)):
        if robot.offsets[j, 12] > _ZERO:
            _slide(frames, parent_of(robot.parents, j), j, robot.offsets[j], q)
        else:
            _turn(frames, parent_of(robot.parents, j), j, robot.offsets[j], q)
    for g in range(len(robot.frame)):
        place(frames, robot.frame[g], robot.bounds, g, centers, g)


class Workspace(NamedTuple):
    """Scratch memory of `block_hits`, which itself allocates nothing."""

    frames: np.ndarray
    """[dof + 1, 12 * W]"""
    centers: np.ndarray
    """[groups, 3 * W] centers of the bounding spheres."""
    row: np.ndarray
    """[1, 3 * W] positions of a row of spheres."""


@kernel()
def make_workspace(robot, scene):
    """Scratch memory for one thread."""
    frames = lanes_array(len(robot.offsets) + 1, 12)
    for k in (0, 4, 8):
        frames[0, k * W : (k + 1) * W] = 1.0
    return Workspace(frames, lanes_array(len(robot.frame), 3), lanes_array(1, 3))


@allocation_free(forceinline=True)
def _touching(x, y, z, radius, solids, k):
    """Mask of the lanes with a sphere that touches obstacle k."""
    dx = x - solids[k, 0]
    dy = y - solids[k, 1]
    dz = z - solids[k, 2]
    u = dx * solids[k, 3] + dy * solids[k, 4] + dz * solids[k, 5]
    v = dx * solids[k, 6] + dy * solids[k, 7] + dz * solids[k, 8]
    w = dx * solids[k, 9] + dy * solids[k, 10] + dz * solids[k, 11]
    w = maximum(absolute(w) - solids[k, 14], _ZERO)
    reach = radius + solids[k, 15]
    if solids[k, 16] > _ZERO:
        r = maximum(sqrt(u * u + v * v) - solids[k, 12], _ZERO)
        return r * r + w * w < reach * reach
    u = maximum(absolute(u) - solids[k, 12], _ZERO)
    v = maximum(absolute(v) - solids[k, 13], _ZERO)
    return u * u + v * v + w * w < reach * reach


@allocation_free(forceinline=True)
def _coordinate(frames, f, i, k, x, y, z):
    """The coordinate k (0 to 2) in the base frame of the point (x, y, z), which is given in frame f, for
    configuration i. x, y and z may also be vectors of 16 points."""
    return (
        x * frames[f, 3 * k * W + i]
        + y * frames[f, (3 * k + 1) * W + i]
        + z * frames[f, (3 * k + 2) * W + i]
        + frames[f, (9 + k) * W + i]
    )


@allocation_free(forceinline=True)
def _place_row(robot, row, frames, f, i):
    """Positions of a row of spheres in configuration (lane) i."""
    x = load(robot.rows, row, 0)
    y = load(robot.rows, row, 1)
    z = load(robot.rows, row, 2)
    return (
        _coordinate(frames, f, i, 0, x, y, z),
        _coordinate(frames, f, i, 1, x, y, z),
        _coordinate(frames, f, i, 2, x, y, z),
    )


@allocation_free(forceinline=True)
def _touching_group(robot, g, frames, near, padding, solids, k, stop_at_first):
    """Mask of the lanes among `near` in which group g touches obstacle k."""
    hits = 0
    f = robot.frame[g]
    first = robot.first_row[g]
    last = robot.first_row[g + 1]
    for row in range(first, last):
        lanes_that_may_touch = near & ~hits
        if last - first > 1:
            x, y, z = _centers_of(frames, f, robot.row_bounds, row)
            lanes_that_may_touch &= _touching(x, y, z, robot.row_bounds[row, 3] + padding, solids, k)
        while lanes_that_may_touch:
            i = first_lane(lanes_that_may_touch)
            lanes_that_may_touch &= lanes_that_may_touch - 1
            x, y, z = _place_row(robot, row, frames, f, i)
            if _touching(x, y, z, load(robot.rows, row, 3) + padding, solids, k) != 0:
                hits |= 1 << i
                if stop_at_first:
                    return hits
    return hits


@allocation_free(forceinline=True)
def _touching_points(robot, g, frames, near, padding, scene, stop_at_first):
    """Mask of the lanes among `near` in which group g touches a point of the scene."""
    hits = 0
    f = robot.frame[g]
    first = robot.first_row[g]
    last = robot.first_row[g + 1]
    for row in range(first, last):
        lanes_that_may_touch = near & ~hits
        if last - first > 1:
            x, y, z = _centers_of(frames, f, robot.row_bounds, row)
            lanes_that_may_touch &= near_points(x, y, z, robot.row_bounds[row, 3] + padding, scene)
        while lanes_that_may_touch:
            i = first_lane(lanes_that_may_touch)
            lanes_that_may_touch &= lanes_that_may_touch - 1
            x, y, z = _place_row(robot, row, frames, f, i)
            if touch_points(x, y, z, load(robot.rows, row, 3) + padding, scene):
                hits |= 1 << i
                if stop_at_first:
                    return hits
    return hits


@allocation_free(forceinline=True)
def _touching_balls(x, y, z, radius, u, v, w, other):
    """Mask of the lanes in which two spheres touch each other."""
    dx = x - u
    dy = y - v
    dz = z - w
    reach = radius + other
    return dx * dx + dy * dy + dz * dz < reach * reach


@allocation_free(forceinline=True)
def _touching_each_other(robot, a, b, near, stop_at_first, work):
    """Mask of the lanes among `near` in which the groups a and b touch each other."""
    hits = 0
    frames = work.frames
    bounds = robot.row_bounds
    for row in range(robot.first_row[a], robot.first_row[a + 1]):
        x, y, z = _centers_of(frames, robot.frame[a], bounds, row)
        u = load(work.centers, b, 0)
        v = load(work.centers, b, 1)
        w = load(work.centers, b, 2)
        near_row = near & ~hits & _touching_balls(x, y, z, bounds[row, 3], u, v, w, robot.bounds[b, 3])
        if near_row == 0:
            continue
        for other_row in range(robot.first_row[b], robot.first_row[b + 1]):
            u, v, w = _centers_of(frames, robot.frame[b], bounds, other_row)
            lanes_that_may_touch = near_row & ~hits
            lanes_that_may_touch &= _touching_balls(x, y, z, bounds[row, 3], u, v, w, bounds[other_row, 3])
            while lanes_that_may_touch:
                i = first_lane(lanes_that_may_touch)
                lanes_that_may_touch &= lanes_that_may_touch - 1
                if _rows_touch(robot, row, robot.frame[a], other_row, robot.frame[b], i, work):
                    hits |= 1 << i
                    if stop_at_first:
                        return hits
    return hits


@allocation_free(forceinline=True)
def _rows_touch(robot, row, f, other, g, i, work):
    """Whether a row of spheres of frame f touches the row `other` of frame g in lane i."""
    x, y, z = _place_row(robot, row, work.frames, f, i)
    u, v, w = _place_row(robot, other, work.frames, g, i)
    radius = load(robot.rows, row, 3)
    placed = work.row
    store(placed, 0, 0, u)
    store(placed, 0, 1, v)
    store(placed, 0, 2, w)
    for t in range(W):
        radii = radius + robot.rows[other, 3 * W + t]
        if _touching_balls(x, y, z, radii, placed[0, t], placed[0, W + t], placed[0, 2 * W + t], _ZERO):
            return True
    return False


@allocation_free(forceinline=True)
def _hits_scene(robot, scene, padding, stop_at_first, work):
    """Mask of the lanes in which the robot touches the scene."""
    # x0 to z1: box around the 16 centers of a group's bounding sphere
    hits = 0
    frames = work.frames
    around = scene.solid_boxes
    solids = scene.solids
    for g in range(len(robot.frame)):
        if robot.frame[g] == 0:
            continue
        x = load(work.centers, g, 0)
        y = load(work.centers, g, 1)
        z = load(work.centers, g, 2)
        x0 = reduce_min(x)
        x1 = reduce_max(x)
        y0 = reduce_min(y)
        y1 = reduce_max(y)
        z0 = reduce_min(z)
        z1 = reduce_max(z)
        reach = robot.bounds[g, 3] + padding
        for row in range(len(around)):
            dx = maximum(maximum(load(around, row, 0) - x1, x0 - load(around, row, 3)), _ZERO)
            dy = maximum(maximum(load(around, row, 1) - y1, y0 - load(around, row, 4)), _ZERO)
            dz = maximum(maximum(load(around, row, 2) - z1, z0 - load(around, row, 5)), _ZERO)
            close = dx * dx + dy * dy + dz * dz < reach * reach
            while close:
                k = row * W + first_lane(close)
                close &= close - 1
                if len(scene.may_touch) and scene.may_touch[g, k]:  # an allowed contact
                    continue
                near = _touching(x, y, z, reach, solids, k) & ~hits
                if near:
                    hits |= _touching_group(robot, g, frames, near, padding, solids, k, stop_at_first)
                    if stop_at_first and hits:
                        return hits
        if len(scene.points) and not far_from_points(scene, x0, x1, y0, y1, z0, z1, reach):
            near = near_points(x, y, z, reach, scene) & ~hits
            if near:
                hits |= _touching_points(robot, g, frames, near, padding, scene, stop_at_first)
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
    i = minimum(maximum((first - row[1]) * row[2], _ZERO), np.float32(TABLE_SIDE - 1))
    j = minimum(maximum((second - row[4]) * row[5], _ZERO), np.float32(TABLE_SIDE - 1))
    cells = gather(row, floor(i) * np.float32(TABLE_SIDE) + floor(j) + np.float32(TABLE_HEADER))
    return lanes_with_bit(cells, bit)


@allocation_free(forceinline=True)
def _hits_itself(robot, q, hits, stop_at_first, work):
    """`hits` plus the lanes in which a checked pair of links touches."""
    centers = work.centers
    bounds = robot.bounds
    for p in range(len(robot.pairs)):
        a = robot.pairs[p, 0]
        b = robot.pairs[p, 1]
        table = robot.pairs[p, 2]
        bit = robot.pairs[p, 3]
        x = load(centers, a, 0)
        y = load(centers, a, 1)
        z = load(centers, a, 2)
        u = load(centers, b, 0)
        v = load(centers, b, 1)
        w = load(centers, b, 2)
        near = _touching_balls(x, y, z, bounds[a, 3], u, v, w, bounds[b, 3]) & ~hits
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
    """Whether each row of q[n, dof] is free of collision."""
    n = len(q)
    out = np.empty(n, np.bool_)
    work = make_workspace(robot, scene)
    block = np.empty((q.shape[1], W), np.float32)
    for start in range(0, n, W):
        take_block(q, start, block)
        hits = block_hits(robot, scene, block, padding, False, work)
        for i in range(min(W, n - start)):
            out[start + i] = not hits >> i & 1
    return out
