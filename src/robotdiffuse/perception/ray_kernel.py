"""Numba kernel of `ray_caster`: renders depth images of shapes by casting rays through the pixels they may
cover."""

import numpy as np

from robotdiffuse.core.kernels import kernel

SPHERE, BOX, CYLINDER, CAPSULE = 0, 1, 2, 3
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_NEAR = np.float32(0.02)
_MISS = np.float32(1e9)


@kernel()
def rectangle(x, y, z, r, intrinsics, h, w):
    """First and last row, first and last column of the pixels that a sphere in the camera's frame may
    cover."""
    fx, fy, cx, cy = intrinsics
    if z + r <= _ZERO:
        return 0, -1, 0, -1
    near, far = max(z - r, _NEAR), z + r
    left, right = (x - r) / (near if x < r else far), (x + r) / (near if x > -r else far)
    top, bottom = (y - r) / (near if y < r else far), (y + r) / (near if y > -r else far)
    u0, u1 = max(np.floor(left * fx + cx), _ZERO), min(np.ceil(right * fx + cx), np.float32(w - 1))
    v0, v1 = max(np.floor(top * fy + cy), _ZERO), min(np.ceil(bottom * fy + cy), np.float32(h - 1))
    return int(v0), int(v1), int(u0), int(u1)


@kernel(fastmath={"contract", "reassoc", "arcp", "nsz"})
def _quadratic(a, b, c, last):
    """The smaller root, or with `last` the larger one, of a t^2 + 2 b t + c; _MISS if there is none."""
    under = b * b - a * c
    if under < _ZERO or a <= _ZERO:
        return _MISS
    root = np.sqrt(under)
    return (root - b if last else -root - b) / a


@kernel(fastmath={"contract", "reassoc", "arcp", "nsz"})
def _sphere(ox, oy, oz, dx, dy, dz, r):
    c = ox * ox + oy * oy + oz * oz - r * r
    return _quadratic(dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz, c, False)


@kernel(fastmath={"contract", "reassoc", "arcp", "nsz"})
def _slab(o, d, half):
    """The parameters at which a ray enters and leaves |x| < half."""
    if abs(d) < np.float32(1e-9):
        return (-_MISS, _MISS) if abs(o) < half else (_MISS, -_MISS)
    a, b = (-half - o) / d, (half - o) / d
    return min(a, b), max(a, b)


@kernel(fastmath={"contract", "reassoc", "arcp", "nsz"})
def _intersect(kind, ox, oy, oz, dx, dy, dz, a, b, c):
    """The parameter, in lengths of its direction, at which a ray enters a shape at the origin; or _MISS."""
    if kind == SPHERE:
        return _sphere(ox, oy, oz, dx, dy, dz, a)
    if kind == BOX:
        x0, x1 = _slab(ox, dx, a)
        y0, y1 = _slab(oy, dy, b)
        z0, z1 = _slab(oz, dz, c)
        enter = max(x0, y0, z0)
        return enter if enter < min(x1, y1, z1) else _MISS
    square, mixed, offset = dx * dx + dy * dy, ox * dx + oy * dy, ox * ox + oy * oy - a * a
    if kind == CYLINDER:
        z0, z1 = _slab(oz, dz, b)
        if square < np.float32(1e-12):
            return z0 if offset < _ZERO else _MISS
        enter, leave = _quadratic(square, mixed, offset, False), _quadratic(square, mixed, offset, True)
        enter = max(enter, z0)
        return enter if enter < min(leave, z1) else _MISS
    side = _quadratic(square, mixed, offset, False)
    if abs(oz + side * dz) > b:
        side = _MISS
    return min(side, _sphere(ox, oy, oz - b, dx, dy, dz, a), _sphere(ox, oy, oz + b, dx, dy, dz, a))


@kernel(fastmath={"contract", "reassoc", "arcp", "nsz"})
def render_depth(kinds, rows, intrinsics, T, depth):
    """Lowers each pixel of `depth` [h w] to the depth of the nearest shape.

    Shapes that contain the camera are not rendered. rows [n, 16]: centre, rotation from the base's frame to
    the shape's, half sizes or radius and half height, radius of a bounding sphere; T: T_base_camera. All
    arrays are float32, except kinds.
    """
    h, w = depth.shape
    fx, fy, cx, cy = intrinsics
    M, o = np.empty((3, 3), np.float32), np.empty(3, np.float32)
    for s in range(len(kinds)):
        row = rows[s]
        px, py, pz = row[0] - T[0, 3], row[1] - T[1, 3], row[2] - T[2, 3]
        x = T[0, 0] * px + T[1, 0] * py + T[2, 0] * pz
        y = T[0, 1] * px + T[1, 1] * py + T[2, 1] * pz
        z = T[0, 2] * px + T[1, 2] * py + T[2, 2] * pz
        v0, v1, u0, u1 = rectangle(x, y, z, row[15], intrinsics, h, w)
        if v1 < v0 or u1 < u0:
            continue
        for i in range(3):
            a, b, c = row[3 + 3 * i], row[4 + 3 * i], row[5 + 3 * i]
            o[i] = -(a * px + b * py + c * pz)
            for j in range(3):
                M[i, j] = a * T[0, j] + b * T[1, j] + c * T[2, j]
        for v in range(v0, v1 + 1):
            q = (np.float32(v) - cy) / fy
            dx, dy, dz = M[0, 1] * q + M[0, 2], M[1, 1] * q + M[1, 2], M[2, 1] * q + M[2, 2]
            for u in range(u0, u1 + 1):
                p = (np.float32(u) - cx) / fx
                t = _intersect(
                    kinds[s], o[0], o[1], o[2],
                    dx + M[0, 0] * p, dy + M[1, 0] * p, dz + M[2, 0] * p,
                    row[12], row[13], row[14],
                )  # fmt: skip
                if _NEAR < t < depth[v, u]:
                    depth[v, u] = t
