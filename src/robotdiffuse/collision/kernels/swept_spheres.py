"""Compiled lower bounds of the clearances of covering spheres along short motions, 16 motions at once.

A motion is given by its middle and the joint motion dq from there to either end. A sphere's centre moves by t
v + r from the middle to the place t in [-1, 1]: v is the Jacobian times dq, and |r| is at most a remainder
that `motion_certificate.py` computes for the whole link. Distance to a convex obstacle is a convex function
along t v and thus nowhere below its tangent: with the distance d and the direction n to the obstacle's
nearest point in the middle, the sphere stays at least d - |n . v| - |r| away. All loops are over the 16
lanes, as in `lane_clearance.py`.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.compiled import parent_of
from robotdiffuse.collision.kernels.lane_clearance import (
    ClearanceWorkspace,
    count_obstacles,
    make_clearance_workspace,
    to_scene,
)
from robotdiffuse.collision.kernels.lane_collision import W, place, place_frames
from robotdiffuse.collision.kernels.point_grid import POINT_RANGE, points_distance
from robotdiffuse.core.kernels import allocation_free, kernel

_ZERO, _TINY = np.float32(0.0), np.float32(1e-9)


class SweptSpheres(NamedTuple):
    """Scratch memory for 16 motions."""

    at: ClearanceWorkspace
    """Frames and positions in the middles."""
    twists: np.ndarray
    """[dof + 1, 6 * W] angular velocity of each frame, and velocity of its point at the base's origin, per
    unit of t."""
    velocities: np.ndarray
    """[spheres, 3 * W] velocities of the sphere's centres per unit of t."""
    speed: np.ndarray
    """[W] upper bound on the speed of any point of a bounding sphere."""
    need: np.ndarray
    """[W] obstacles further away than this plus the sphere's own motion are ignored [m]."""
    clearance: np.ndarray
    """[1, W] signed distances in the middles."""
    lower: np.ndarray
    """[1, W] lower bounds along the motions, without the remainder."""


@kernel()
def make_swept_spheres(robot, scene):
    """Scratch memory for one thread."""
    return SweptSpheres(
        make_clearance_workspace(robot, count_obstacles(scene)),
        np.zeros((len(robot.offsets) + 1, 6 * W), np.float32),
        np.empty((len(robot.spheres), 3 * W), np.float32),
        np.empty(W, np.float32),
        np.empty(W, np.float32),
        np.empty((1, W), np.float32),
        np.empty((1, W), np.float32),
    )


@allocation_free(fastmath=True)
def _twist(parent, frame, slides, dq, out):
    """Writes the twist behind a joint from that before it; the joint's axis is the z axis of its frame."""
    for i in range(W):
        ax, ay, az = frame[2 * W + i] * dq[i], frame[5 * W + i] * dq[i], frame[8 * W + i] * dq[i]
        x, y, z = frame[9 * W + i], frame[10 * W + i], frame[11 * W + i]
        if slides:
            out[i], out[W + i], out[2 * W + i] = parent[i], parent[W + i], parent[2 * W + i]
            ux, uy, uz = ax, ay, az
        else:
            out[i] = parent[i] + ax
            out[W + i] = parent[W + i] + ay
            out[2 * W + i] = parent[2 * W + i] + az
            ux, uy, uz = y * az - z * ay, z * ax - x * az, x * ay - y * ax
        out[3 * W + i] = parent[3 * W + i] + ux
        out[4 * W + i] = parent[4 * W + i] + uy
        out[5 * W + i] = parent[5 * W + i] + uz


@allocation_free(fastmath=True)
def _velocity(twist, at, s, out):
    """Writes the velocity of a point that is fixed to a frame to row s of `out`."""
    for i in range(W):
        x, y, z = at[s, i], at[s, W + i], at[s, 2 * W + i]
        a, b, c = twist[i], twist[W + i], twist[2 * W + i]
        out[s, i] = b * z - c * y + twist[3 * W + i]
        out[s, W + i] = c * x - a * z + twist[4 * W + i]
        out[s, 2 * W + i] = a * y - b * x + twist[5 * W + i]


@allocation_free(fastmath=True)
def _speed(twist, other, at, s, radius, out):
    """Writes upper bounds on the speed of any point of a ball that is fixed to a frame, seen from another
    frame."""
    for i in range(W):
        x, y, z = at[s, i], at[s, W + i], at[s, 2 * W + i]
        a, b, c = twist[i] - other[i], twist[W + i] - other[W + i], twist[2 * W + i] - other[2 * W + i]
        u = b * z - c * y + twist[3 * W + i] - other[3 * W + i]
        v = c * x - a * z + twist[4 * W + i] - other[4 * W + i]
        w = a * y - b * x + twist[5 * W + i] - other[5 * W + i]
        out[i] = np.sqrt(u * u + v * v + w * w) + radius * np.sqrt(a * a + b * b + c * c)


@allocation_free()
def place_motions(robot, q, dq, work):
    """Writes the frames in the middles q[dof, 16] and their twists along dq[dof, 16]."""
    place_frames(robot, q, work.at.frames, work.at.centres)
    work.at.placed[:] = False
    for j in range(len(robot.offsets)):
        slides = robot.offsets[j, 12] > _ZERO
        parent = parent_of(robot.parents, j)
        _twist(work.twists[parent], work.at.frames[j + 1], slides, dq[j], work.twists[j + 1])


@allocation_free(inline="always")
def _place_group(robot, g, work):
    if not work.at.placed[g]:
        frame = robot.frame[g]
        for s in range(robot.first[g], robot.first[g + 1]):
            place(work.at.frames, frame, robot.spheres, s, work.at.positions, s)
            _velocity(work.twists[frame], work.at.positions, s, work.velocities)
        work.at.placed[g] = True


@allocation_free(fastmath=True)
def _past_spheres(at, v, s, radius, obstacles, near, n, clearance, lower):
    """Lowers clearance and bound of sphere s to those of the obstacles with near[n + k]."""
    for k in range(len(obstacles)):
        if not near[n + k]:
            continue
        x, y, z, reach = obstacles[k, 0], obstacles[k, 1], obstacles[k, 2], obstacles[k, 3] + radius
        for i in range(W):
            dx, dy, dz = at[s, i] - x, at[s, W + i] - y, at[s, 2 * W + i] - z
            d = np.sqrt(dx * dx + dy * dy + dz * dz)
            towards = abs(dx * v[s, i] + dy * v[s, W + i] + dz * v[s, 2 * W + i]) / max(d, _TINY)
            clearance[0, i] = min(clearance[0, i], d - reach)
            lower[0, i] = min(lower[0, i], d - reach - towards)


@allocation_free(fastmath=True)
def _past_boxes(at, v, s, radius, obstacles, near, n, clearance, lower):
    """The same for boxes."""
    for k in range(len(obstacles)):
        if not near[n + k]:
            continue
        x, y, z = obstacles[k, 0], obstacles[k, 1], obstacles[k, 2]
        a00, a01, a02 = obstacles[k, 3], obstacles[k, 4], obstacles[k, 5]
        a10, a11, a12 = obstacles[k, 6], obstacles[k, 7], obstacles[k, 8]
        a20, a21, a22 = obstacles[k, 9], obstacles[k, 10], obstacles[k, 11]
        hx, hy, hz = obstacles[k, 12], obstacles[k, 13], obstacles[k, 14]
        for i in range(W):
            dx, dy, dz = at[s, i] - x, at[s, W + i] - y, at[s, 2 * W + i] - z
            vx, vy, vz = v[s, i], v[s, W + i], v[s, 2 * W + i]
            a = a00 * dx + a01 * dy + a02 * dz
            b = a10 * dx + a11 * dy + a12 * dz
            c = a20 * dx + a21 * dy + a22 * dz
            # speeds away from the box's centre
            p = (a00 * vx + a01 * vy + a02 * vz) * (-1 if a < _ZERO else 1)
            q = (a10 * vx + a11 * vy + a12 * vz) * (-1 if b < _ZERO else 1)
            r = (a20 * vx + a21 * vy + a22 * vz) * (-1 if c < _ZERO else 1)
            a, b, c = abs(a) - hx, abs(b) - hy, abs(c) - hz
            inside = min(max(max(a, b), c), _ZERO)
            a, b, c = max(a, _ZERO), max(b, _ZERO), max(c, _ZERO)
            d = np.sqrt(a * a + b * b + c * c)
            towards = abs(a * p + b * q + c * r) / max(d, _TINY)
            clearance[0, i] = min(clearance[0, i], d + inside - radius)
            lower[0, i] = min(lower[0, i], d + inside - radius - towards)


@allocation_free(fastmath=True)
def _past_round(at, v, s, radius, obstacles, flat_ends, near, n, clearance, lower):
    """The same for cylinders (`flat_ends`) or capsules."""
    for k in range(len(obstacles)):
        if not near[n + k]:
            continue
        x, y, z = obstacles[k, 0], obstacles[k, 1], obstacles[k, 2]
        a00, a01, a02 = obstacles[k, 3], obstacles[k, 4], obstacles[k, 5]
        a10, a11, a12 = obstacles[k, 6], obstacles[k, 7], obstacles[k, 8]
        a20, a21, a22 = obstacles[k, 9], obstacles[k, 10], obstacles[k, 11]
        half = obstacles[k, 13]
        wide = obstacles[k, 12] if flat_ends else _ZERO
        reach = radius if flat_ends else radius + obstacles[k, 12]
        for i in range(W):
            dx, dy, dz = at[s, i] - x, at[s, W + i] - y, at[s, 2 * W + i] - z
            vx, vy, vz = v[s, i], v[s, W + i], v[s, 2 * W + i]
            a = a00 * dx + a01 * dy + a02 * dz
            b = a10 * dx + a11 * dy + a12 * dz
            c = a20 * dx + a21 * dy + a22 * dz
            axial = (a20 * vx + a21 * vy + a22 * vz) * (-1 if c < _ZERO else 1)
            from_axis = np.sqrt(a * a + b * b)
            radial = a * (a00 * vx + a01 * vy + a02 * vz) + b * (a10 * vx + a11 * vy + a12 * vz)
            radial /= max(from_axis, _TINY)
            e, c = from_axis - wide, abs(c) - half
            inside = min(max(e, c), _ZERO)
            e, c = max(e, _ZERO), max(c, _ZERO)
            d = np.sqrt(e * e + c * c)
            towards = abs(e * radial + c * axial) / max(d, _TINY)
            clearance[0, i] = min(clearance[0, i], d + inside - reach)
            lower[0, i] = min(lower[0, i], d + inside - reach - towards)


@allocation_free()
def _past_points(at, v, s, radius, scene, need, clearance, lower):
    """The same for points. The nearest point changes along the motion, so the sphere's whole speed counts."""
    for i in range(W):
        x, y, z = v[s, i], v[s, W + i], v[s, 2 * W + i]
        speed = np.sqrt(x * x + y * y + z * z)
        limit = min(need[i] + speed, POINT_RANGE) + radius
        d = points_distance(scene, at[s, i], at[s, W + i], at[s, 2 * W + i], limit) - radius
        clearance[0, i] = min(clearance[0, i], d)
        lower[0, i] = min(lower[0, i], d - speed)


@allocation_free(fastmath=True)
def _mark_near(bounds, obstacles, radius, need, speed, near):
    """Marks the obstacles that a group's bounding sphere comes near to in any motion; returns how many."""
    count = 0
    for k in range(obstacles):
        total = 0
        for i in range(W):
            total += np.int32(bounds[k, i] - radius - speed[i] < need[i])
        near[k] = total > 0
        count += near[k]
    return count


@allocation_free(inline="always")
def _reset(work):
    for i in range(W):
        work.clearance[0, i] = work.lower[0, i] = work.need[i]


@allocation_free()
def group_along(robot, scene, g, work):
    """Writes clearances of a group to the scene, and their bounds along the motions, to `work.clearance` and
    `work.lower`.

    Both are at most `work.need`, which the caller sets for each motion; a motion with a negative value is
    skipped.
    """
    at, near, frame, radius = work.at, work.at.near, robot.frame[g], robot.bounds[g, 3]
    _reset(work)
    to_scene(at.centres, g, scene, radius, near, True, at.bounds)
    _speed(work.twists[frame], work.twists[0], at.centres, g, radius, work.speed)
    obstacles = count_obstacles(scene) - (len(scene.points) == 0)
    if _mark_near(at.bounds, obstacles, radius, work.need, work.speed, near) == 0:
        return
    _place_group(robot, g, work)
    v = work.velocities
    for s in range(robot.first[g], robot.first[g + 1]):
        r, n = robot.spheres[s, 3], 0
        _past_spheres(at.positions, v, s, r, scene.spheres, near, n, work.clearance, work.lower)
        n += len(scene.spheres)
        _past_boxes(at.positions, v, s, r, scene.boxes, near, n, work.clearance, work.lower)
        n += len(scene.boxes)
        _past_round(at.positions, v, s, r, scene.cylinders, True, near, n, work.clearance, work.lower)
        n += len(scene.cylinders)
        _past_round(at.positions, v, s, r, scene.capsules, False, near, n, work.clearance, work.lower)
        n += len(scene.capsules)
        if len(scene.points) and near[n]:
            _past_points(at.positions, v, s, r, scene, work.need, work.clearance, work.lower)


@allocation_free(fastmath=True)
def _near_each_other(a, s, b, t, radii, need, speed):
    """Number of lanes in which two balls can come near to each other."""
    total = 0
    for i in range(W):
        dx, dy, dz = a[s, i] - b[t, i], a[s, W + i] - b[t, W + i], a[s, 2 * W + i] - b[t, 2 * W + i]
        total += np.int32(np.sqrt(dx * dx + dy * dy + dz * dz) - radii - speed[i] < need[i])
    return total


@allocation_free(fastmath=True)
def _past_each_other(at, v, s, t, radii, clearance, lower):
    """Lowers clearance and bound of spheres s and t. Only the difference of their velocities along the line
    between the centres counts, whatever frame it is seen from."""
    for i in range(W):
        dx, dy, dz = at[s, i] - at[t, i], at[s, W + i] - at[t, W + i], at[s, 2 * W + i] - at[t, 2 * W + i]
        vx, vy, vz = v[s, i] - v[t, i], v[s, W + i] - v[t, W + i], v[s, 2 * W + i] - v[t, 2 * W + i]
        d = np.sqrt(dx * dx + dy * dy + dz * dz)
        towards = abs(dx * vx + dy * vy + dz * vz) / max(d, _TINY)
        clearance[0, i] = min(clearance[0, i], d - radii)
        lower[0, i] = min(lower[0, i], d - radii - towards)


@allocation_free()
def pair_along(robot, p, work):
    """As `group_along`, between the links of a checked pair."""
    a, b = robot.pairs[p, 0], robot.pairs[p, 1]
    spheres, bounds, first = robot.spheres, robot.bounds, robot.first
    centres, positions = work.at.centres, work.at.positions
    of_a, of_b = work.twists[robot.frame[a]], work.twists[robot.frame[b]]
    _reset(work)
    _speed(of_a, of_b, centres, a, bounds[a, 3], work.speed)
    radii = bounds[a, 3] + bounds[b, 3]
    if _near_each_other(centres, a, centres, b, radii, work.need, work.speed) == 0:
        return
    _place_group(robot, a, work)
    _place_group(robot, b, work)
    for s in range(first[a], first[a + 1]):
        r = spheres[s, 3]
        _speed(of_a, of_b, positions, s, _ZERO, work.speed)
        if _near_each_other(positions, s, centres, b, r + bounds[b, 3], work.need, work.speed) == 0:
            continue
        for t in range(first[b], first[b + 1]):
            _past_each_other(positions, work.velocities, s, t, r + spheres[t, 3], work.clearance, work.lower)
