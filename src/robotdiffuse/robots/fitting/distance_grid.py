"""A voxel grid of distances from a solid, which measures how far a hull sticks out of it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import KDTree

from robotdiffuse.core.kernels import kernel
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.fitting.convex_hulls import planes_of

MAX_SPLITS = 60
"""Largest number of times that a triangle is halved."""
# At a tight place, parts may stick out by this fraction of the usual distance; the allowance grows by this
# slope with the distance from there.
TIGHT_FRACTION = 0.125
TIGHT_SLOPE = 0.3


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Distances of voxels from a solid, zero inside [m]."""

    origin: Float[ndarray, "3"]
    pitch: float
    distance: Float[ndarray, "nx ny nz"]

    @staticmethod
    def around(soups: list[Float[ndarray, "n 3 3"]], voxels: int, finest: float) -> "DistanceGrid":
        """The grid around triangles, with about this many voxels of at least the `finest` size [m]."""
        corners = np.concatenate(soups).reshape(-1, 3)
        low = corners.min(0)
        high = corners.max(0)
        size = np.maximum(high - low, finest)
        pitch = max(float(np.prod(size) / voxels) ** (1 / 3), size.max() / 300, finest)
        origin = low - 2.5 * pitch
        shape = np.ceil((high - origin) / pitch).astype(int) + 3
        occupied = np.zeros(shape, dtype=bool)
        for soup in soups:
            _mark(occupied, split(soup, pitch / 2), origin, pitch)
        found: Any = ndimage.label(~occupied)
        free = found[0] == found[0][0, 0, 0]
        return DistanceGrid(origin, pitch, ndimage.distance_transform_edt(free) * pitch)

    def near_tight(
        self, tight: Float[ndarray, "n 3"], concavity: float
    ) -> tuple["DistanceGrid", "DistanceGrid"]:
        """Two copies with distances enlarged near `tight` places, so that sticking out there counts more.

        The first is zero elsewhere; the second keeps the other distances.
        """
        near = np.argwhere((self.distance > 0) & (self.distance < 3 * concavity))
        far = KDTree(tight).query(self.origin + (near + 0.5) * self.pitch)[0]
        allowed = TIGHT_FRACTION * concavity + TIGHT_SLOPE * np.maximum(far - 2 * concavity, 0.0)
        near = near[allowed < concavity]
        allowed = allowed[allowed < concavity]
        alone = np.zeros_like(self.distance)
        alone[tuple(near.T)] = self.distance[tuple(near.T)] * concavity / allowed
        return replace(self, distance=alone), replace(self, distance=np.maximum(alone, self.distance))

    def concavity(self, hull: ConvexMesh) -> float:
        """How far a hull sticks out of the solid, approximately [m]."""
        low = np.floor((hull.vertices.min(0) - self.origin) / self.pitch).astype(int)
        high = np.ceil((hull.vertices.max(0) - self.origin) / self.pitch).astype(int) + 1
        return _farthest_inside(self.distance, self.origin, self.pitch, low, high, *planes_of(hull))


@kernel()
def _mark(occupied, triangles, origin, pitch):
    """Mark the voxels that contain corners of triangles."""
    for t in range(len(triangles)):
        for k in range(3):
            i = int((triangles[t, k, 0] - origin[0]) / pitch)
            j = int((triangles[t, k, 1] - origin[1]) / pitch)
            occupied[i, j, int((triangles[t, k, 2] - origin[2]) / pitch)] = True


@kernel()
def _farthest_inside(distance, origin, pitch, low, high, normals, offsets):
    """Largest value of `distance` among voxels whose centres are within the planes."""
    best = 0.0
    for i in range(max(low[0], 0), min(high[0], distance.shape[0])):
        x = origin[0] + (i + 0.5) * pitch
        for j in range(max(low[1], 0), min(high[1], distance.shape[1])):
            y = origin[1] + (j + 0.5) * pitch
            for k in range(max(low[2], 0), min(high[2], distance.shape[2])):
                if distance[i, j, k] <= best:
                    continue
                z = origin[2] + (k + 0.5) * pitch
                inside = True
                for f in range(len(offsets)):
                    if normals[f, 0] * x + normals[f, 1] * y + normals[f, 2] * z > offsets[f]:
                        inside = False
                        break
                if inside:
                    best = distance[i, j, k]
    return best


def split(triangles: Float[ndarray, "n 3 3"], size: "float | Float[ndarray, 'n']") -> Float[ndarray, "m 3 3"]:
    """Halve triangles at their longest edge until no edge is longer than `size` [m]."""
    sizes = np.broadcast_to(np.asarray(size, np.float64), len(triangles))
    return _split(np.ascontiguousarray(triangles, np.float64), sizes**2)


@kernel()
def _split(triangles, squares):
    out = np.empty((4 * len(triangles) + 64, 3, 3))
    count = 0
    open_ones = np.empty((MAX_SPLITS + 2, 3, 3))
    for t in range(len(triangles)):
        open_ones[0] = triangles[t]
        left = 1
        while left > 0:
            left -= 1
            longest = -1.0
            k = 0
            for i in range(3):
                j = (i + 1) % 3
                square = 0.0
                for d in range(3):
                    square += (open_ones[left, i, d] - open_ones[left, j, d]) ** 2
                if square > longest:
                    longest = square
                    k = i
            if longest <= squares[t] or left >= MAX_SPLITS:
                if count == len(out):
                    out = np.concatenate((out, np.empty_like(out)))
                out[count] = open_ones[left]
                count += 1
                continue
            for d in range(3):
                a = open_ones[left, k, d]
                b = open_ones[left, (k + 1) % 3, d]
                c = open_ones[left, (k + 2) % 3, d]
                middle = 0.5 * (a + b)
                open_ones[left, 0, d] = a
                open_ones[left, 1, d] = middle
                open_ones[left, 2, d] = c
                open_ones[left + 1, 0, d] = middle
                open_ones[left + 1, 1, d] = b
                open_ones[left + 1, 2, d] = c
            left += 2
    return out[:count].copy()
