"""Noise of depth images: how large it is, and images without most of it."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.core.kernels import kernel
from robotdiffuse.core.types import Pose
from robotdiffuse.perception.depth_view import DepthView

MIN_RETURNS = 4
"""A pixel with fewer returns among its 3 x 3 counts as without a return."""


@kernel(nogil=True)
def median_filter(depth):
    """Each pixel with a return as the median of the returns of its 3 x 3 pixels, the nearer one of two; 0
    elsewhere."""
    h, w = depth.shape
    out = np.zeros((h, w), np.float32)
    some = np.empty(9, np.float32)
    for v in range(h):
        for u in range(w):
            if not depth[v, u] > 0:
                continue
            count = 0
            for row in range(max(v - 1, 0), min(v + 2, h)):
                for column in range(max(u - 1, 0), min(u + 2, w)):
                    d = depth[row, column]
                    if not d > 0:
                        continue
                    at = count
                    while at > 0 and some[at - 1] > d:
                        some[at] = some[at - 1]
                        at -= 1
                    some[at] = d
                    count += 1
            if count >= MIN_RETURNS:
                out[v, u] = some[(count - 1) // 2]
    return out


ROW_STEP = 4
"""Every so many rows are examined for noise."""
ORDER = 4
"""Order of the differences that noise is estimated from: those of a sphere a few pixels wide are near 0."""
MIN_DIFFERENCES = 200
"""Fewest differences that noise is estimated from."""
DIFFERENCE_PER_SPREAD = 0.6745 * 70**0.5
"""The median absolute fourth difference of normal numbers of standard deviation 1."""
MIN_SPREAD = 4e-4
"""Images with less noise are taken as they are: the filter takes away what is a pixel wide. At a distance of
1 m [m]."""
MARGIN_SPREADS = 1.5
"""Points of the arm may lie this many standard deviations of a pixel's depth farther from it. The median of
nine pixels has 0.4 of the deviation of one."""


class FilteredDepth(NamedTuple):
    """A depth image to use, and its noise."""

    depth: Float32[ndarray, "h w"]
    """Distance along the optical axis, as in DepthView [m]."""
    spread: float
    """Standard deviation of a pixel's depth at a distance of 1 m before the filter [m]; it grows with the
    square of the distance."""


@lru_cache(maxsize=32)
def filtered(view: DepthView) -> FilteredDepth:
    """The view's image; if it is noisy, each pixel with a return is the median of those of the 3 x 3 around.

    Images made of clouds have no pixels of their own, and count as without noise. The last results are
    cached: a call with views asks for the same ones several times.
    """
    depth = for_kernels(view.depth, np.float32)
    spread = 0.0 if view.cloud is not None else depth_spread(depth)
    if spread < MIN_SPREAD:
        return FilteredDepth(depth, 0.0)
    return FilteredDepth(median_filter(depth), spread)


def depth_spread(depth: Float32[ndarray, "h w"]) -> float:
    """The standard deviation of an image's depth at a distance of 1 m [m], as its pixels show.

    Of a flat surface, inverse depth is linear in the pixels, and of a curved one nearly a polynomial; where
    the error of depth grows with its square, that of inverse depth is the same everywhere. So differences of
    high order of inverse depth show it. 0 for images with few returns.
    """
    some = depth[::ROW_STEP]
    seen = np.isfinite(some) & (some > 0)
    differences = np.divide(1.0, some, out=np.zeros_like(some), where=seen)
    for _ in range(ORDER):
        differences = np.diff(differences, axis=1)
        seen = seen[:, 1:] & seen[:, :-1]
    found = np.abs(differences[seen])
    return float(np.median(found)) / DIFFERENCE_PER_SPREAD if len(found) >= MIN_DIFFERENCES else 0.0


def grown_for_noise(
    spheres: Float[ndarray, "n 4"], T_base_camera: Pose, spread: float
) -> Float[ndarray, "n 4"]:
    """The arm's spheres, in the base frame, enlarged by the noise of depth where they are."""
    ahead = (spheres[:, :3] - T_base_camera[:3, 3]) @ T_base_camera[:3, 2]
    grown = spheres.copy()
    grown[:, 3] += MARGIN_SPREADS * spread * np.maximum(ahead, 0.0) ** 2
    return grown
