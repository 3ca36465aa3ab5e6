"""Compiled lower bounds of the distances between convex meshes and shapes along short motions.

A plane that separates two convex bodies proves that they do not touch, no matter how the plane was found.
The algorithm of Gilbert, Johnson and Keerthi (GJK, 1988) finds the best plane for the poses in the middle of
the motion, starting from the plane of the previous motion. The bound is the smallest gap between the two
bodies' vertices along the plane's normal during the motion. Each vertex moves from its position in the middle
by t v + r with t in [-1, 1], where v is the vertex's velocity and r a small remainder of second order (see
`lane_clearance.py`). All computations are in float64.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.frames import base_frames, gap_to_solid, parent_of
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.robots.frame_kernel import (
    column,
    cross,
    dot,
    length,
    minus,
    placed,
    plus,
    rotated_back,
    step,
    times,
    write,
)

MAX_GJK_STEPS = 32
"""Largest number of iterations of GJK; usually it takes three to eight."""
GJK_RELATIVE_TOLERANCE = 0.02
"""GJK ends when the error of the distance is below this fraction of the distance."""
GJK_ABSOLUTE_TOLERANCE = 1e-7
"""GJK also ends when the error of the distance is below this [m]."""


class Hulls(NamedTuple):
    """Convex parts of a robot's links: convex hulls, each inflated by a radius."""

    vertices: np.ndarray
    """[3, vertices] in the coordinates of the part's frame."""
    first: np.ndarray
    """[parts + 1] first vertex of each part."""
    frame: np.ndarray
    """[parts] index of the frame that each part is fixed to."""
    balls: np.ndarray
    """[parts, 4] center and radius of a ball around the whole part, in the part's frame."""
    rounding: np.ndarray
    """[parts] radius by which the hull is inflated."""


class Solids(NamedTuple):
    """Obstacles, each the Minkowski sum of a box, a disc around the box's z axis and a ball."""

    rotation: np.ndarray
    """[n, 3, 3] R_box_base"""
    middle: np.ndarray
    """[n, 3] center of the box in the base frame."""
    half: np.ndarray
    """[n, 3] half edges of the box."""
    disc: np.ndarray
    """[n] radius of the disc."""
    rounding: np.ndarray
    """[n] radius of the ball."""
    is_bound: np.ndarray
    """[n] whether the solid is only the bounding box of a surface or a point cloud. Exact distances to such
    obstacles are left to Coal."""
    may_touch: np.ndarray
    """[checks, n] whether the link of each `Check` may touch the obstacle; shape [0, 0] without allowed
    contacts."""


class Posture(NamedTuple):
    """Scratch memory of one thread: the robot's frames in the middle of the current motion, and the planes
    that GJK found for earlier motions."""

    frames: np.ndarray
    """[dof + 1, 3, 4]"""
    twists: np.ndarray
    """[dof + 1, 6] as in `lane_clearance.py`."""
    planes: np.ndarray
    """[parts, solids + parts, 3] for each pair of a part (first index) and a solid or another part, the unit
    normal of the last separating plane. It points towards the first part; it is zero before the first plane
    is found."""
    simplex: np.ndarray
    """[4, 3] vertices of GJK's simplex."""
    edges: np.ndarray
    """[3, 3] edges of the simplex from its newest vertex."""
    points: np.ndarray
    """[3, 3] the current normal, and the support points of the two bodies along it."""


@kernel()
def make_posture(hulls, solids, dof):
    """Scratch memory of one thread."""
    parts = len(hulls.frame)
    planes = np.zeros((parts, len(solids.disc) + parts, 3))
    edges = np.empty((3, 3))
    return Posture(base_frames(dof), np.zeros((dof + 1, 6)), planes, np.empty((4, 3)), edges, edges.copy())


@kernel()
def pose(offsets, parents, slides, q, dq, posture):
    """Writes the frames at q and their twists along dq to `posture`.

    offsets[dof, 4, 4] and parents[dof] are those of `Robot`; parents is None for a chain.
    """
    for j in range(len(q)):
        parent = parent_of(parents, j)
        child = posture.frames[j + 1]
        before = posture.twists[parent]
        twist = posture.twists[j + 1]
        step(posture.frames[parent], offsets[j], slides[j], q[j], child)
        axis = times(dq[j], column(child, 2))
        write(plus(before, times(0.0 if slides[j] else 1.0, axis)), twist)
        write(plus(before[3:], axis if slides[j] else cross(column(child, 3), axis)), twist[3:])


@inner_kernel()
def relative_twist(posture, frame, reference):
    """The motion of one frame relative to the frame `reference`: its angular velocity, and the velocity of
    the point of the frame that is at the origin of the robot's base frame. All vectors are in the base
    frame."""
    twist = posture.twists[frame]
    reference_twist = posture.twists[reference]
    return minus(twist, reference_twist), minus(twist[3:], reference_twist[3:])


@inner_kernel()
def part_travel(hulls, p, reference, posture):
    """Upper bound on how far any point of a part moves, relative to frame `reference`, from the middle of the
    motion to either of its ends [m]; the remainder r (see the module's docstring) is not included."""
    frame = hulls.frame[p]
    ball = hulls.balls[p]
    turning, moving = relative_twist(posture, frame, reference)
    velocity = plus(cross(turning, placed(posture.frames[frame], ball)), moving)
    return length(velocity) + ball[3] * length(turning)


@inner_kernel()
def ball_to_solid(hulls, p, solids, o, posture):
    """Lower bound of the distance of a part to an obstacle in the middle of the motion, computed from the
    ball around the part [m]."""
    ball = hulls.balls[p]
    center = placed(posture.frames[hulls.frame[p]], ball)
    return gap_to_solid(center, solids, o) - ball[3]


@inner_kernel(fastmath=True)
def _lowest(vertices, first, last, n, m, speed):
    """Minimum over vertices of a - |b|. a is the vertex's height along the normal n, b its speed along the
    normal: `speed` plus vertex . m."""
    minimum = np.inf
    for i in range(first, last):
        a = vertices[0, i] * n[0] + vertices[1, i] * n[1] + vertices[2, i] * n[2]
        b = vertices[0, i] * m[0] + vertices[1, i] * m[1] + vertices[2, i] * m[2] + speed
        minimum = min(minimum, a - abs(b))
    return minimum


@inner_kernel()
def _support_of_part(hulls, p, posture, sign, row):
    """Writes to points[row] the vertex of a part that is furthest in the direction sign * points[0]."""
    T = posture.frames[hulls.frame[p]]
    points = posture.points
    vertices = hulls.vertices
    x, y, z = rotated_back(T, points[0])
    best = -np.inf
    furthest = hulls.first[p]
    for i in range(hulls.first[p], hulls.first[p + 1]):
        a = sign * (vertices[0, i] * x + vertices[1, i] * y + vertices[2, i] * z)
        if a > best:
            best = a
            furthest = i
    write(placed(T, vertices[:, furthest]), points[row])


@inner_kernel()
def _support_of_solid(solids, o, posture):
    """Writes to points[2] the point of an obstacle (without its rounding) that is furthest in the direction
    points[0]."""
    R = solids.rotation[o]
    half = solids.half[o]
    n = posture.points[0]
    a = dot(R[0], n)
    b = dot(R[1], n)
    c = dot(R[2], n)
    disc = solids.disc[o] / max(np.sqrt(a * a + b * b), 1e-300)
    at = np.copysign(half[0], a) + disc * a, np.copysign(half[1], b) + disc * b, np.copysign(half[2], c)
    write(plus(rotated_back(R, at), solids.middle[o]), posture.points[2])


@inner_kernel()
def _lowest_along(hulls, p, reference, sign, posture):
    """Minimum height of a part in the direction sign * points[0] at the start and at the end of the motion
    [m]. The remainder r is left out; velocities are relative to frame `reference`."""
    n = posture.points[0]
    frame = hulls.frame[p]
    turning, moving = relative_twist(posture, frame, reference)
    at_start = np.inf
    at_stop = np.inf
    for i in range(hulls.first[p], hulls.first[p + 1]):
        at = placed(posture.frames[frame], hulls.vertices[:, i])
        height = sign * dot(n, at)
        speed = sign * dot(n, plus(cross(turning, at), moving))
        at_start = min(at_start, height - speed)
        at_stop = min(at_stop, height + speed)
    return at_start - hulls.rounding[p], at_stop - hulls.rounding[p]


@inner_kernel()
def separation(hulls, p, solids, other, reference, posture):
    """Widths of the gap between two bodies along the unit normal points[0] [m].

    Returns the gap in the middle of the motion, and the smallest gap along the motion. The smallest gap
    leaves out the remainder r (see the module's docstring) and uses velocities relative to frame `reference`.
    `other` is the index of an obstacle or, if negative, -1 minus the index of a part. If part `other` is not
    fixed to frame `reference`, the smallest gap includes its motion too.
    """
    n = posture.points[0]
    frame = hulls.frame[p]
    T = posture.frames[frame]
    origin = column(T, 3)
    turning, moving = relative_twist(posture, frame, reference)
    # n . (w x p) = (n x w) . p
    turned = cross(n, turning)
    speed = dot(turned, origin) + dot(n, moving)
    # height and speed along the normal as linear functions of a vertex in the part's frame
    offset = dot(n, origin) - hulls.rounding[p]
    heights = rotated_back(T, n)
    first = hulls.first[p]
    last = hulls.first[p + 1]
    along = _lowest(hulls.vertices, first, last, heights, rotated_back(T, turned), speed) + offset
    middle = _lowest(hulls.vertices, first, last, heights, (0.0, 0.0, 0.0), 0.0) + offset
    if other >= 0:
        _support_of_solid(solids, other, posture)
        reach = solids.rounding[other]
    else:
        _support_of_part(hulls, -1 - other, posture, 1.0, 2)
        reach = hulls.rounding[-1 - other]
    reach += dot(n, posture.points[2])
    # 1e-9 covers floating-point errors in the length of the normal, which are multiplied by the size of the
    # bodies
    if other < 0 and hulls.frame[-1 - other] != reference:
        start, stop = _lowest_along(hulls, p, reference, 1.0, posture)
        other_start, other_stop = _lowest_along(hulls, -1 - other, reference, -1.0, posture)
        return middle - reach - 1e-9, min(start + other_start, stop + other_stop) - 1e-9
    return middle - reach - 1e-9, along - reach - 1e-9


@inner_kernel()
def _contains_origin(e, new):
    """Whether the tetrahedron with the vertices `new`, `new` + e[0], `new` + e[1] and `new` + e[2] contains
    the origin: whether all its barycentric coordinates are positive."""
    inside = 1.0
    for k in range(3):
        normal = cross(e[(k + 1) % 3], e[(k + 2) % 3])
        volume = dot(e[k], normal)
        if abs(volume) < 1e-30:
            return False
        share = -dot(new, normal) / volume
        inside -= share
        if share <= 0:
            return False
    return inside > 0


@inner_kernel()
def _nearest(simplex, count, edges, nearest):
    """Writes to `nearest` the point of a simplex that is nearest to the origin.

    Reduces the simplex to the smallest face that contains this point, and returns the face's number of
    vertices, or 0 if the origin is inside. The face always contains the last vertex, which GJK has just
    added.
    """
    # vertex, edges (i == j) and triangles that contain the last vertex
    new = simplex[count - 1]
    best_square = dot(new, new)
    face = 0
    write(new, nearest)
    for k in range(count - 1):
        write(minus(simplex[k], new), edges[k])
    if count == 4 and _contains_origin(edges, new):
        return 0
    for i in range(count - 1):
        for j in range(i, count - 1):
            e = edges[i]
            f = edges[j]
            a = dot(e, e)
            b = dot(e, f)
            c = dot(f, f)
            d = -dot(new, e)
            g = -dot(new, f)
            x = 0.0
            y = 0.0
            if i == j:
                x = d / max(a, 1e-300)
                inside = 0 < x < 1
            else:
                area = max(a * c - b * b, 1e-300)
                x = (d * c - g * b) / area
                y = (g * a - d * b) / area
                inside = x > 0 and y > 0 and x + y < 1
            if inside:
                point = plus(new, plus(times(x, e), times(y, f)))
                square = dot(point, point)
                if square < best_square:
                    best_square = square
                    face = 1 << i | 1 << j
                    write(point, nearest)
    at = 0
    for k in range(count):
        if k == count - 1 or face >> k & 1:
            write(simplex[k], simplex[at])
            at += 1
    return at


@inner_kernel()
def find_plane(hulls, p, solids, other, posture):
    """Replaces points[0], an initial guess, by the normal of the plane with the widest gap between two bodies
    in the middle of the motion. Returns False if the bodies touch or nearly touch."""
    # `best` and `gap` are a lower and an upper bound of the distance of the bodies without their roundings
    points = posture.points
    simplex = posture.simplex
    rounding = hulls.rounding[p] + (solids.rounding[other] if other >= 0 else hulls.rounding[-1 - other])
    best = -np.inf
    gap = np.inf
    count = 0
    normal = column(points.T, 0)
    for _ in range(MAX_GJK_STEPS):
        _support_of_part(hulls, p, posture, -1.0, 1)
        if other >= 0:
            _support_of_solid(solids, other, posture)
        else:
            _support_of_part(hulls, -1 - other, posture, 1.0, 2)
        write(minus(points[1], points[2]), simplex[count])
        reached = dot(simplex[count], points[0])
        if reached > best:
            best = reached
            normal = column(points.T, 0)
        count = _nearest(simplex, count + 1, posture.edges, points[0])
        before = gap
        gap = length(points[0])
        if count == 0 or gap - rounding < GJK_ABSOLUTE_TOLERANCE:
            return False
        for r in range(3):
            points[0, r] /= gap
        if (
            gap - best <= max(GJK_RELATIVE_TOLERANCE * (gap - rounding), GJK_ABSOLUTE_TOLERANCE)
            or gap >= before
        ):
            break
    write(normal, points[0])
    return best > rounding


@kernel()
def best_plane(hulls, p, solids, other, reference, enough, plane, posture):
    """Gaps between two bodies along the normal of a separating plane [m], and whether GJK was run.

    The first gap is in the middle of the motion, the second is the smallest along the motion, without the
    remainder r. GJK is run only if `plane`, the last plane of this pair, is zero or shows a gap of less than
    `enough` along the motion. It replaces `plane`, unless the bodies touch or nearly touch. After GJK, the
    first gap is at most about 2 % below the distance, or -inf if the bodies touch or nearly touch.
    """
    n = posture.points[0]
    write(plane, n)
    if plane.any():
        middle, along = separation(hulls, p, solids, other, reference, posture)
        if along >= enough:
            return middle, along, False
    else:
        center = placed(posture.frames[hulls.frame[p]], hulls.balls[p])
        if other >= 0:
            write(minus(center, solids.middle[other]), n)
        else:
            q = -1 - other
            write(minus(center, placed(posture.frames[hulls.frame[q]], hulls.balls[q])), n)
        distance = length(n)
        for r in range(3):
            n[r] = n[r] / distance if distance > 0 else 1.0 / np.sqrt(3.0)
    if not find_plane(hulls, p, solids, other, posture):
        return -np.inf, -np.inf, True
    write(n, plane)
    middle, along = separation(hulls, p, solids, other, reference, posture)
    return middle, along, True
