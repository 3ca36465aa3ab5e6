"""Compiled lower bounds of the distances between convex meshes and shapes along short motions.

A plane that separates two convex bodies proves that they do not touch, no matter how the plane was found.
The algorithm of Gilbert, Johnson and Keerthi (GJK, 1988) finds the best plane for the poses in the middle of
the motion, starting from the plane of the previous motion. The bound needs only this plane: the bound is the
smallest gap, along the plane's normal, between the vertices of one body and the other body during the motion.
Each vertex moves from its position in the middle by t v + r with t in [-1, 1], where v is the vertex's
velocity and r a small remainder of second order (see `lane_clearance.py`). All computations are in float64.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.frames import parent_of, placed, point_to_box
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.robots.frame_kernel import step

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
    """[n] whether the solid is only the bounding box of a surface or a point cloud. Only Coal computes
    exact distances to such obstacles."""
    may_touch: np.ndarray
    """[checks, n] whether the link of a check may touch the obstacle; shape [0, 0] without allowed
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
    frames = np.zeros((dof + 1, 3, 4))
    for k in range(3):
        frames[0, k, k] = 1.0
    parts = len(hulls.frame)
    planes = np.zeros((parts, len(solids.disc) + parts, 3))
    return Posture(
        frames, np.zeros((dof + 1, 6)), planes, np.empty((4, 3)), np.empty((3, 3)), np.empty((3, 3))
    )


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
        for r in range(3):
            a = (r + 1) % 3
            b = (r + 2) % 3
            axis = child[r, 2] * dq[j]
            moment = (child[a, 3] * child[b, 2] - child[b, 3] * child[a, 2]) * dq[j]
            twist[r] = before[r] + (0.0 if slides[j] else axis)
            twist[3 + r] = before[3 + r] + (axis if slides[j] else moment)


@inner_kernel()
def part_travel(hulls, p, base, posture):
    """Upper bound on how far any point of a part moves, relative to frame `base`, from the middle of the
    motion to either of its ends [m]; the remainder r (see the module's docstring) is not included."""
    frame = hulls.frame[p]
    ball = hulls.balls[p]
    twist = posture.twists[frame]
    base_twist = posture.twists[base]
    T = posture.frames[frame]
    a = twist[0] - base_twist[0]
    b = twist[1] - base_twist[1]
    c = twist[2] - base_twist[2]
    x = placed(T, ball, 0)
    y = placed(T, ball, 1)
    z = placed(T, ball, 2)
    u = b * z - c * y + twist[3] - base_twist[3]
    v = c * x - a * z + twist[4] - base_twist[4]
    w = a * y - b * x + twist[5] - base_twist[5]
    return np.sqrt(u * u + v * v + w * w) + ball[3] * np.sqrt(a * a + b * b + c * c)


@inner_kernel()
def ball_to_solid(hulls, p, solids, o, posture):
    """Lower bound of the distance of a part to an obstacle in the middle of the motion, computed from the
    ball around the part [m]."""
    T = posture.frames[hulls.frame[p]]
    ball = hulls.balls[p]
    x = placed(T, ball, 0)
    y = placed(T, ball, 1)
    z = placed(T, ball, 2)
    gap = point_to_box(x, y, z, solids.rotation[o], solids.middle[o], solids.half[o], solids.disc[o])
    return gap - solids.rounding[o] - ball[3]


@inner_kernel()
def ball_to_ball(hulls, p, q, posture):
    """Lower bound of the distance of two parts in the middle of the motion, computed from the balls around
    them [m]."""
    S = posture.frames[hulls.frame[p]]
    T = posture.frames[hulls.frame[q]]
    total = 0.0
    a = hulls.balls[p]
    b = hulls.balls[q]
    for r in range(3):
        total += (placed(S, a, r) - placed(T, b, r)) ** 2
    return np.sqrt(total) - a[3] - b[3]


@inner_kernel(fastmath=True)
def _lowest(vertices, first, last, x, y, z, offset, u, v, w, speed):
    """Minimum over vertices of a - |b|, plus `offset`. a is the vertex's height along a normal, b its speed
    along the normal; both are linear in the vertex."""
    minimum = np.inf
    for i in range(first, last):
        a = vertices[0, i] * x + vertices[1, i] * y + vertices[2, i] * z
        b = vertices[0, i] * u + vertices[1, i] * v + vertices[2, i] * w + speed
        minimum = min(minimum, a - abs(b))
    return minimum + offset


@inner_kernel()
def _furthest(vertices, first, last, x, y, z):
    """Index of the vertex that is furthest in the direction (x, y, z)."""
    best = -np.inf
    at = first
    for i in range(first, last):
        a = vertices[0, i] * x + vertices[1, i] * y + vertices[2, i] * z
        if a > best:
            best = a
            at = i
    return at


@inner_kernel()
def _support_of_part(hulls, p, posture, sign, row):
    """Writes to points[row] the vertex of a part that is furthest in the direction sign * points[0]."""
    T = posture.frames[hulls.frame[p]]
    points = posture.points
    x = sign * points[0, 0]
    y = sign * points[0, 1]
    z = sign * points[0, 2]
    i = _furthest(
        hulls.vertices,
        hulls.first[p],
        hulls.first[p + 1],
        T[0, 0] * x + T[1, 0] * y + T[2, 0] * z,
        T[0, 1] * x + T[1, 1] * y + T[2, 1] * z,
        T[0, 2] * x + T[1, 2] * y + T[2, 2] * z,
    )
    for r in range(3):
        points[row, r] = placed(T, hulls.vertices[:, i], r)


@inner_kernel()
def _support_of_solid(solids, o, posture):
    """Writes to points[2] the point of an obstacle (without its rounding) that is furthest in the direction
    points[0]."""
    R = solids.rotation[o]
    points = posture.points
    x = points[0, 0]
    y = points[0, 1]
    z = points[0, 2]
    a = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
    b = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
    c = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
    disc = solids.disc[o] / max(np.sqrt(a * a + b * b), 1e-300)
    a = np.copysign(solids.half[o, 0], a) + disc * a
    b = np.copysign(solids.half[o, 1], b) + disc * b
    c = np.copysign(solids.half[o, 2], c)
    for r in range(3):
        points[2, r] = R[0, r] * a + R[1, r] * b + R[2, r] * c + solids.middle[o, r]


@inner_kernel()
def _lowest_along(hulls, p, base, sign, posture):
    """Minimum height of a part in the direction sign * points[0] at the start and at the end of the motion
    [m]. The remainder r is left out; velocities are relative to frame `base`."""
    n = posture.points[0]
    T = posture.frames[hulls.frame[p]]
    twist = posture.twists[hulls.frame[p]]
    base_twist = posture.twists[base]
    at_start = np.inf
    at_stop = np.inf
    for i in range(hulls.first[p], hulls.first[p + 1]):
        vertex = hulls.vertices[:, i]
        x = placed(T, vertex, 0)
        y = placed(T, vertex, 1)
        z = placed(T, vertex, 2)
        a = twist[0] - base_twist[0]
        b = twist[1] - base_twist[1]
        c = twist[2] - base_twist[2]
        u = b * z - c * y + twist[3] - base_twist[3]
        v = c * x - a * z + twist[4] - base_twist[4]
        w = a * y - b * x + twist[5] - base_twist[5]
        height = sign * (n[0] * x + n[1] * y + n[2] * z)
        speed = sign * (n[0] * u + n[1] * v + n[2] * w)
        at_start = min(at_start, height - speed)
        at_stop = min(at_stop, height + speed)
    return at_start - hulls.rounding[p], at_stop - hulls.rounding[p]


@inner_kernel()
def separation(hulls, p, solids, other, base, posture):
    """Widths of the gap between two bodies along the unit normal points[0] [m].

    Returns the gap in the middle of the motion, and the smallest gap along the motion. The smallest gap
    leaves out the remainder r (see the module's docstring) and uses velocities relative to frame `base`.
    `other` is the index of an obstacle or, if negative, -1 minus the index of a part. If this part is not
    fixed to frame `base`, its motion is included.
    """
    x = posture.points[0, 0]
    y = posture.points[0, 1]
    z = posture.points[0, 2]
    frame = hulls.frame[p]
    T = posture.frames[frame]
    twist = posture.twists[frame]
    base_twist = posture.twists[base]
    a = twist[0] - base_twist[0]
    b = twist[1] - base_twist[1]
    c = twist[2] - base_twist[2]
    # n . (w x p) = (n x w) . p
    u = y * c - z * b
    v = z * a - x * c
    w = x * b - y * a
    speed = u * T[0, 3] + v * T[1, 3] + w * T[2, 3]
    speed += x * (twist[3] - base_twist[3]) + y * (twist[4] - base_twist[4]) + z * (twist[5] - base_twist[5])
    # height and speed along the normal as linear functions of a vertex in the part's frame
    offset = x * T[0, 3] + y * T[1, 3] + z * T[2, 3] - hulls.rounding[p]
    lx = T[0, 0] * x + T[1, 0] * y + T[2, 0] * z
    ly = T[0, 1] * x + T[1, 1] * y + T[2, 1] * z
    lz = T[0, 2] * x + T[1, 2] * y + T[2, 2] * z
    lu = T[0, 0] * u + T[1, 0] * v + T[2, 0] * w
    lv = T[0, 1] * u + T[1, 1] * v + T[2, 1] * w
    lw = T[0, 2] * u + T[1, 2] * v + T[2, 2] * w
    first = hulls.first[p]
    last = hulls.first[p + 1]
    along = _lowest(hulls.vertices, first, last, lx, ly, lz, offset, lu, lv, lw, speed)
    middle = _lowest(hulls.vertices, first, last, lx, ly, lz, offset, 0.0, 0.0, 0.0, 0.0)
    reach = 0.0
    if other >= 0:
        _support_of_solid(solids, other, posture)
        reach = solids.rounding[other]
    else:
        _support_of_part(hulls, -1 - other, posture, 1.0, 2)
        reach = hulls.rounding[-1 - other]
    at = posture.points[2]
    reach += x * at[0] + y * at[1] + z * at[2]
    if other < 0 and hulls.frame[-1 - other] != base:
        start, stop = _lowest_along(hulls, p, base, 1.0, posture)
        other_start, other_stop = _lowest_along(hulls, -1 - other, base, -1.0, posture)
        return middle - reach - 1e-9, min(start + other_start, stop + other_stop) - 1e-9
    # 1e-9 covers floating-point errors in the length of the normal, which are multiplied by the size of the
    # bodies
    return middle - reach - 1e-9, along - reach - 1e-9


@inner_kernel()
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner_kernel()
def _contains_origin(e, new):
    """Whether the tetrahedron with the vertices `new`, `new` + e[0], `new` + e[1] and `new` + e[2] contains
    the origin: whether all its barycentric coordinates are positive."""
    inside = 1.0
    for k in range(3):
        a = e[(k + 1) % 3]
        b = e[(k + 2) % 3]
        x = a[1] * b[2] - a[2] * b[1]
        y = a[2] * b[0] - a[0] * b[2]
        z = a[0] * b[1] - a[1] * b[0]
        volume = e[k, 0] * x + e[k, 1] * y + e[k, 2] * z
        if abs(volume) < 1e-30:
            return False
        share = -(new[0] * x + new[1] * y + new[2] * z) / volume
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
    best_square = _dot(new, new)
    face = 0
    for r in range(3):
        nearest[r] = new[r]
        for k in range(count - 1):
            edges[k, r] = simplex[k, r] - new[r]
    if count == 4 and _contains_origin(edges, new):
        return 0
    for i in range(count - 1):
        for j in range(i, count - 1):
            e = edges[i]
            f = edges[j]
            a = _dot(e, e)
            b = _dot(e, f)
            c = _dot(f, f)
            d = -_dot(new, e)
            g = -_dot(new, f)
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
                total = 0.0
                for r in range(3):
                    total += (new[r] + x * e[r] + y * f[r]) ** 2
                if total < best_square:
                    best_square = total
                    face = 1 << i | 1 << j
                    for r in range(3):
                        nearest[r] = new[r] + x * e[r] + y * f[r]
    at = 0
    for k in range(count):
        if k == count - 1 or face >> k & 1:
            for r in range(3):
                simplex[at, r] = simplex[k, r]
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
    n0 = points[0, 0]
    n1 = points[0, 1]
    n2 = points[0, 2]
    for _ in range(MAX_GJK_STEPS):
        _support_of_part(hulls, p, posture, -1.0, 1)
        if other >= 0:
            _support_of_solid(solids, other, posture)
        else:
            _support_of_part(hulls, -1 - other, posture, 1.0, 2)
        for r in range(3):
            simplex[count, r] = points[1, r] - points[2, r]
        reached = _dot(simplex[count], points[0])
        if reached > best:
            best = reached
            n0 = points[0, 0]
            n1 = points[0, 1]
            n2 = points[0, 2]
        count = _nearest(simplex, count + 1, posture.edges, points[0])
        before = gap
        gap = np.sqrt(_dot(points[0], points[0]))
        if count == 0 or gap - rounding < GJK_ABSOLUTE_TOLERANCE:
            return False
        for r in range(3):
            points[0, r] /= gap
        if (
            gap - best <= max(GJK_RELATIVE_TOLERANCE * (gap - rounding), GJK_ABSOLUTE_TOLERANCE)
            or gap >= before
        ):
            break
    points[0, 0] = n0
    points[0, 1] = n1
    points[0, 2] = n2
    return best > rounding


@kernel()
def best_plane(hulls, p, solids, other, base, enough, plane, posture):
    """Gaps between two bodies along the normal of a separating plane [m], and whether GJK was run.

    The first gap is in the middle of the motion, the second is the smallest along the motion, without the
    remainder r. GJK is run only if the gap of `plane`, the last plane of this pair, is less than `enough`
    along the motion; then `plane` is replaced. After GJK, the first gap is at most about 2 % below the
    distance, or -inf if the bodies touch or nearly touch.
    """
    n = posture.points[0]
    cached = False
    for r in range(3):
        n[r] = plane[r]
        cached |= plane[r] != 0.0
    if cached:
        middle, along = separation(hulls, p, solids, other, base, posture)
        if along >= enough:
            return middle, along, False
    else:
        T = posture.frames[hulls.frame[p]]
        for r in range(3):
            n[r] = placed(T, hulls.balls[p], r)
            if other >= 0:
                n[r] -= solids.middle[other, r]
            else:
                n[r] -= placed(posture.frames[hulls.frame[-1 - other]], hulls.balls[-1 - other], r)
        length = np.sqrt(_dot(n, n))
        for r in range(3):
            n[r] = n[r] / length if length > 0 else 1.0 / np.sqrt(3.0)
    if not find_plane(hulls, p, solids, other, posture):
        return -np.inf, -np.inf, True
    for r in range(3):
        plane[r] = n[r]
    middle, along = separation(hulls, p, solids, other, base, posture)
    return middle, along, True
