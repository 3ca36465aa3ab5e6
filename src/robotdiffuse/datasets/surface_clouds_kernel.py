"""Numba kernel of `surface_clouds`: samples whole surfaces of packed scenes on the CPU."""

import numpy as np

from robotdiffuse.core.kernels import kernel
from robotdiffuse.scenes.scene_arrays import BOX, SPHERE

_ONE, _TWO, _HALF = np.float32(1.0), np.float32(2.0), np.float32(0.5)
_UNIT = np.float32(2.0**-24)
_MASK = np.uint64(2**24 - 1)


@kernel(inline="always")
def _next(x):
    """xorshift64 (G. Marsaglia 2003)."""
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    return x


@kernel(nogil=True)
def fill_clouds(kinds, params, seeds, out):
    """Writes points that are uniform by area over the shapes of each scene to out[n, count, 3].

    Scenes without shapes get zeros. kinds [n, k] and params [n, k, 10] as in `PackedScenes`; seeds uint64[n].
    """
    n, k = kinds.shape
    count = out.shape[1]
    ends, faces = np.empty(k, np.float32), np.empty((k, 2), np.float32)
    turn = np.empty((k, 3, 3), np.float32)
    for i in range(n):
        total = np.float32(0.0)
        for j in range(k):
            total += _prepare(kinds[i, j], params[i, j], faces[j], turn[j])
            ends[j] = total
        if total <= np.float32(0.0):
            out[i] = np.float32(0.0)
            continue
        x = seeds[i] | np.uint64(1)
        for _ in range(8):  # mixes seeds that differ in few bits
            x = _next(x)
        for p in range(count):
            x = _next(x)
            pick = np.float32(x >> np.uint64(40)) * _UNIT * total
            j = 0
            while j < k - 1 and pick >= ends[j]:
                j += 1
            x = _next(x)
            u = np.float32(x >> np.uint64(40)) * _UNIT
            v = np.float32((x >> np.uint64(16)) & _MASK) * _UNIT
            if kinds[i, j] == SPHERE:
                a, b = _TWO * u - _ONE, _TWO * v - _ONE
                s = a * a + b * b
                while s >= _ONE:
                    x = _next(x)
                    a = np.float32(x >> np.uint64(40)) * _UNIT * _TWO - _ONE
                    b = np.float32((x >> np.uint64(16)) & _MASK) * _UNIT * _TWO - _ONE
                    s = a * a + b * b
                # G. Marsaglia 1972: a direction from a point of the unit disc
                ring, radius = _TWO * np.sqrt(_ONE - s), params[i, j, 3]
                out[i, p, 0] = params[i, j, 0] + radius * ring * a
                out[i, p, 1] = params[i, j, 1] + radius * ring * b
                out[i, p, 2] = params[i, j, 2] + radius * (_ONE - _TWO * s)
                continue
            start = ends[j - 1] if j > 0 else np.float32(0.0)
            offset = pick - start
            side = _HALF if x & np.uint64(1) else -_HALF
            u, v = u - _HALF, v - _HALF
            if offset < faces[j, 0]:
                a, b, c = side, u, v
            elif offset < faces[j, 1]:
                a, b, c = u, side, v
            else:
                a, b, c = u, v, side
            for r in range(3):
                out[i, p, r] = params[i, j, r] + turn[j, r, 0] * a + turn[j, r, 1] * b + turn[j, r, 2] * c


@kernel()
def _prepare(kind, row, faces, turn):
    """Area of a shape [m^2]. For boxes, also writes the cumulative areas of face pairs and axes times
    sizes."""
    if kind == SPHERE:
        return np.float32(4.0 * np.pi) * row[3] * row[3]
    if kind != BOX:
        return np.float32(0.0)
    a, b, c = row[3], row[4], row[5]
    faces[0] = _TWO * b * c
    faces[1] = faces[0] + _TWO * c * a
    norm = np.sqrt(row[6] * row[6] + row[7] * row[7] + row[8] * row[8] + row[9] * row[9])
    w, x, y, z = row[6] / norm, row[7] / norm, row[8] / norm, row[9] / norm
    turn[0, 0], turn[0, 1], turn[0, 2] = (
        _ONE - _TWO * (y * y + z * z),
        _TWO * (x * y - w * z),
        _TWO * (x * z + w * y),
    )
    turn[1, 0], turn[1, 1], turn[1, 2] = (
        _TWO * (x * y + w * z),
        _ONE - _TWO * (x * x + z * z),
        _TWO * (y * z - w * x),
    )
    turn[2, 0], turn[2, 1], turn[2, 2] = (
        _TWO * (x * z - w * y),
        _TWO * (y * z + w * x),
        _ONE - _TWO * (x * x + y * y),
    )
    for r in range(3):
        turn[r, 0] *= a
        turn[r, 1] *= b
        turn[r, 2] *= c
    return faces[1] + _TWO * a * b
