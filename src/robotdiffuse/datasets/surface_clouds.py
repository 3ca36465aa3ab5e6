"""Samples point clouds of many packed scenes at once, during training.

As in `sample_surface`, points are uniform by area over the spheres and boxes of a scene. This compiled
version is faster, and it releases Python's global interpreter lock, so that threads sample in parallel.
"""

import numpy as np
import torch
from jaxtyping import Float32
from torch import Generator, Tensor

from robotdiffuse.collision.kernels.frames import write_rotation
from robotdiffuse.core.kernels import HALF, ONE, ZERO, kernel
from robotdiffuse.scenes.packed_scenes import NONE, SPHERE, PackedScenes
from robotdiffuse.scenes.surface_points import VisibleRegion

# Largest number of samples that are drawn for each requested point; samples outside the region are dropped.
_OVERSAMPLING = 8
_TWO = np.float32(2.0)
_QUARTER = np.float32(0.25)
_FOUR = np.float32(4.0)
_PI = np.float32(np.pi)
# Turn 24 random bits, as many as a float32 holds exactly, into a number from 0 to 1.
_UNIT = np.float32(2.0**-24)
_MASK = np.uint64(2**24 - 1)

EVERYWHERE = VisibleRegion(floor=-1e9, reach=1e9)


def surface_clouds(
    scenes: PackedScenes,
    count: int,
    generator: Generator,
    *,
    region: VisibleRegion = EVERYWHERE,
    ordered: bool = False,
) -> Float32[Tensor, "n count 3"]:
    """`count` points on the obstacles of each scene [m], independent and uniform by area.

    The result is on the generator's device. If too few samples are inside the region, points are repeated;
    if none is, the scene's cloud is all zeros.

    region: the points are inside it.
    ordered: whether they are sorted by x, then y, then z, for encoders that depend on the order.
    """
    clouds = torch.zeros(len(scenes), count, 3, dtype=torch.float32)
    if scenes.kinds.size and count:
        seeds = torch.randint(2**62, (len(scenes),), generator=generator, device=generator.device)
        fill_clouds(
            np.ascontiguousarray(scenes.kinds),
            np.ascontiguousarray(scenes.params),
            seeds.cpu().numpy().view(np.uint64),
            np.array([*region.center, region.reach, region.floor], np.float32),
            clouds.numpy(),
        )
        if ordered:
            points = clouds.numpy()
            order = np.lexsort(np.moveaxis(points, -1, 0)[::-1])
            clouds = torch.from_numpy(np.take_along_axis(points, order[..., None], 1))
    return clouds.to(generator.device)


@kernel(inline="always")
def _next(x):
    """xorshift64 (G. Marsaglia 2003)."""
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    return x


@kernel(nogil=True, error_model="numpy")
def fill_clouds(kinds, params, seeds, region, out):
    """Writes points inside the region, uniform by area over the shapes of each scene, to out[n, count, 3].

    If samples inside are too few, points are repeated; if there are none, zeros are written. kinds: [n, k],
    and params: [n, k, 10], as in `PackedScenes`. seeds: uint64[n]. region: x, y and z of its center, its
    reach and its floor [m].
    """
    n, k = kinds.shape
    count = out.shape[1]
    ends = np.empty(k, np.float32)
    faces = np.empty((k, 2), np.float32)
    axes = np.empty((k, 3, 3), np.float32)
    for i in range(n):
        total = ZERO
        last = 0
        for j in range(k):
            area = _prepare(kinds[i, j], params[i, j], faces[j], axes[j])
            if area > ZERO and _may_intersect(region, params[i, j], axes[j]):
                total += area
                last = j
            ends[j] = total
        x = seeds[i] | np.uint64(1)
        for _ in range(8):  # mixes seeds that differ in few bits
            x = _next(x)
        filled = 0
        draws = _OVERSAMPLING * count
        if total <= ZERO:
            draws = 0
        for _ in range(draws):
            if filled == count:
                break
            # choose a shape j with a probability in proportion to its area
            x = _next(x)
            pick = np.float32(x >> np.uint64(40)) * _UNIT * total
            j = 0
            while j < last and pick >= ends[j]:
                j += 1
            # a point (u, v) of the unit square around 0; for a sphere, of the largest disc in this square
            while True:
                x = _next(x)
                u = np.float32(x >> np.uint64(40)) * _UNIT - HALF
                v = np.float32((x >> np.uint64(16)) & _MASK) * _UNIT - HALF
                s = u * u + v * v
                if kinds[i, j] != SPHERE or s < _QUARTER:
                    break
            if kinds[i, j] == SPHERE:
                # the direction that belongs to a point of the disc (G. Marsaglia 1972)
                ring = _FOUR * np.sqrt(ONE - _FOUR * s)
                radius = params[i, j, 3]
                out[i, filled, 0] = params[i, j, 0] + radius * ring * u
                out[i, filled, 1] = params[i, j, 1] + radius * ring * v
                out[i, filled, 2] = params[i, j, 2] + radius * (ONE - _TWO * _FOUR * s)
            else:
                # The point (u, v) on one of the six faces: the offset of `pick` within the area of the box
                # chooses a pair of opposite faces, and the lowest bit of x one of the two. The columns of
                # `axes` are the edges of the box. Column `face` is normal to the pair; columns face - 1 and
                # face - 2 are the other two edges (negative indices count from the end).
                offset = pick - (ends[j - 1] if j > 0 else ZERO)
                side = HALF if x & np.uint64(1) else -HALF
                face = int(offset >= faces[j, 0]) + int(offset >= faces[j, 1])
                for r in range(3):
                    axis = axes[j, r]
                    out[i, filled, r] = (
                        params[i, j, r] + axis[face] * side + axis[face - 1] * u + axis[face - 2] * v
                    )
            if _inside(region, out[i, filled]):
                filled += 1
        for p in range(filled, count):
            for r in range(3):
                out[i, p, r] = out[i, p - filled, r] if filled > 0 else ZERO


@kernel(error_model="numpy")
def _prepare(kind, row, faces, axes):
    """Area of a shape [m²]. Writes the edges of its box to the columns of `axes` [m]. For a box, writes to
    `faces` the area of the pair of faces that are normal to the first edge, and this area plus that of the
    second pair."""
    if kind == NONE:
        return ZERO
    if kind == SPHERE:
        a = b = c = _TWO * row[3]
        area = _PI * a * a
        write_rotation(ONE, ZERO, ZERO, ZERO, axes)
    else:
        a = row[3]
        b = row[4]
        c = row[5]
        faces[0] = _TWO * b * c
        faces[1] = faces[0] + _TWO * c * a
        area = faces[1] + _TWO * a * b
        norm = np.sqrt(row[6] * row[6] + row[7] * row[7] + row[8] * row[8] + row[9] * row[9])
        write_rotation(row[6] / norm, row[7] / norm, row[8] / norm, row[9] / norm, axes)
    for i, size in enumerate((a, b, c)):
        for r in range(3):
            axes[r, i] *= size
    return area


@kernel()
def _may_intersect(region, row, axes):
    """Whether the bounding box of a shape reaches into the region."""
    squared_gap = ZERO
    half = ZERO
    for r in range(3):
        half = HALF * (abs(axes[r, 0]) + abs(axes[r, 1]) + abs(axes[r, 2]))
        away = max(abs(row[r] - region[r]) - half, ZERO)
        squared_gap += away * away
    # `half` is now half the box's height
    return row[2] + half > region[4] and squared_gap < region[3] * region[3]


@kernel(inline="always")
def _inside(region, point):
    """Whether a point [m] is in the region."""
    x = point[0] - region[0]
    y = point[1] - region[1]
    z = point[2] - region[2]
    return point[2] > region[4] and x * x + y * y + z * z < region[3] * region[3]
