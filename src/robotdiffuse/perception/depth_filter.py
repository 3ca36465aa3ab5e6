"""Noise of depth images: estimates its size, and filters most of it."""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int32
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.errors import MAX_COORDINATE, InputError, form, located, numbers, shown
from robotdiffuse.core.kernels import kernel
from robotdiffuse.core.types import Points, Spheres, Values, for_kernels
from robotdiffuse.perception.depth_view import (
    FARTHEST,
    NEAREST,
    DepthImage,
    DepthNoise,
    DepthView,
    Pixels,
)

MIN_RETURNS = 4
"""A pixel with a return is kept if its 3 x 3 neighborhood has at least this many returns, itself included."""
MIN_AROUND = 6
"""A pixel without a return is filled if its 3 x 3 neighborhood has at least this many returns: it is then a
dropout on a surface."""


@kernel(nogil=True)
def median_filter(depth):
    """The median of the returns in the 3 x 3 neighborhood of each pixel; of an even number of returns, the
    nearer of the two in the middle. 0 where the returns are fewer than MIN_RETURNS or MIN_AROUND."""
    h, w = depth.shape
    out = np.zeros((h, w), np.float32)
    returns = np.empty(9, np.float32)  # sorted, the nearest first
    for v in range(h):
        for u in range(w):
            count = 0
            for row in range(max(v - 1, 0), min(v + 2, h)):
                for column in range(max(u - 1, 0), min(u + 2, w)):
                    d = depth[row, column]
                    if not d > 0:
                        continue
                    at = count
                    while at > 0 and returns[at - 1] > d:
                        returns[at] = returns[at - 1]
                        at -= 1
                    returns[at] = d
                    count += 1
            if count >= (MIN_RETURNS if depth[v, u] > 0 else MIN_AROUND):
                out[v, u] = returns[(count - 1) // 2]
    return out


SQUARE = 11
"""Edge of the squares in which flat surfaces are smoothed [pixels]."""
FLATNESS = 2.0
"""A square is flat if the variance of inverse depth about the fitted plane is at most this many times the
variance of the noise. With a larger factor, small objects would be taken for noise."""


def _inverse_depths(depth: ndarray) -> tuple[ndarray, ndarray]:
    """Which pixels have a return, and the inverse depth of these pixels; 0 for the others."""
    seen = np.isfinite(depth) & (depth > 0)
    return seen, np.divide(1.0, depth, out=np.zeros(depth.shape), where=seen)


def smoothed(depth: DepthImage, spread: float) -> tuple[DepthImage, float]:
    """The image, smoothed on flat surfaces, and the share of smoothed pixels among the pixels with a return.

    If the square of SQUARE x SQUARE pixels around a pixel is flat, the pixel gets the depth of the plane
    through the square. On a plane, inverse depth is a linear function of the pixel, so its value in the
    middle is the mean of the square. spread: standard deviation of depth at a distance of 1 m [m].
    """
    from scipy.ndimage import correlate1d, uniform_filter, uniform_filter1d

    seen, inverse = _inverse_depths(depth)
    is_complete = uniform_filter(seen.astype(np.float32), SQUARE, mode="constant") > 1 - 0.5 / SQUARE**2
    mean = uniform_filter(inverse, SQUARE)
    variance = uniform_filter(inverse**2, SQUARE) - mean**2
    ramp = np.arange(SQUARE) - SQUARE // 2
    for axis in (0, 1):
        slope = uniform_filter1d(correlate1d(inverse, ramp / (ramp**2).sum(), axis), SQUARE, 1 - axis)
        variance -= slope**2 * (ramp**2).mean()
    flat = is_complete & (variance < FLATNESS * spread**2)
    smooth = np.divide(1.0, mean, out=depth.astype(np.float64), where=flat).astype(np.float32)
    return smooth, float(flat.sum() / max(seen.sum(), 1))


PATCH = 20
"""Edge of the patches on which noise is estimated [pixels]: several times the correlation length of errors
that was measured on recorded sensors."""
# An estimate needs at least MIN_PATCHES; at most MAX_PATCHES, spread over the image, are used.
MIN_PATCHES = 12
MAX_PATCHES = 100
MIN_PATCH_RETURNS = 0.7
"""Patches with a smaller fraction of returns are ignored."""
FLAT_SHARE = 0.3
"""The image's noise is this quantile of its patches' noise, since patches with more noise contain edges or
objects."""
FIT_ROUNDS = 3
"""Rounds of the fit of a plane; each round after the first ignores pixels whose errors were larger than
OUTLIER_SPREADS standard deviations, estimated from the median error of the patch."""
OUTLIER_SPREADS = 3.0
MIN_SPREAD = 4e-4
"""Images with less noise than this, at a distance of 1 m [m], are not filtered, since the filter removes
objects that are one pixel wide."""
MARGIN_SPREADS = 3.75
"""Points may belong to the arm if their distance from it is at most this many standard deviations of the
filtered depth."""
MEDIAN_SPREAD = 0.4
"""Standard deviation of the median of nine independent numbers, relative to that of one number."""
MEDIAN_LENGTH = 0.85
"""Correlation length that the median filter gives to independent errors [pixels], as in `DepthNoise`."""


class FilteredDepth(NamedTuple):
    """A filtered depth image, and the noise that it still has, as standard deviations of depth at a distance
    of 1 m [m]. Noise grows with the square of the distance."""

    depth: DepthImage
    """Distance along the optical axis, as in DepthView [m]."""
    spread: float
    """Noise of all pixels with a return."""
    edge_spread: float
    """Noise of the pixels that are not on a flat surface."""


@lru_cache(maxsize=32)
def filtered(view: DepthView) -> FilteredDepth:
    """The view's image; if it is noisy, filtered by `median_filter` and `smoothed`.

    Images made from clouds count as free of noise, since their pixels are not those of a sensor; so do images
    without a stated noise that are too small for `patch_noise`. The last 32 results are cached, because
    planning with views uses each image several times.
    """
    depth = np.maximum(for_kernels(view.depth, np.float32), np.float32(0.0))
    if view.cloud is not None:
        return FilteredDepth(depth, 0.0, 0.0)
    noise = view.noise
    spread = patch_noise(depth)[0] if noise is None else noise.spread
    if spread < MIN_SPREAD:
        return FilteredDepth(depth, 0.0, 0.0)
    depth = median_filter(depth)
    if noise is None:
        spread, neighbor_correlation = patch_noise(depth)
        squared_length = correlation_length(neighbor_correlation) ** 2
    else:
        # the median does not reduce the part of the errors that neighboring pixels share; this part is taken
        # to be the correlation of diagonal neighbors
        together = np.exp(-1 / max(noise.correlation, 0.01) ** 2)
        spread *= MEDIAN_SPREAD + (1 - MEDIAN_SPREAD) * float(together)
        squared_length = noise.correlation**2 + MEDIAN_LENGTH**2
    smooth, flat_share = smoothed(depth, spread)
    # the part of the variance that smoothing leaves: errors are alike in an area of 2 pi length^2
    noise_left = min(1.0, 2 * np.pi * squared_length / SQUARE**2)
    return FilteredDepth(smooth, spread * float(np.sqrt(1 - flat_share * (1 - noise_left))), spread)


def patch_noise(depth: DepthImage) -> tuple[float, float]:
    """The standard deviation of an image's depth at a distance of 1 m [m], measured on flat patches, and the
    correlation of the errors of neighboring pixels; both are 0 if fewer than MIN_PATCHES patches have enough
    returns, as in images of 64 x 48 pixels.

    On a flat surface, inverse depth is a linear function of the pixel. If the error of depth grows with the
    square of the depth, the error of inverse depth is the same everywhere.
    """
    rows, columns = (n // PATCH for n in depth.shape)
    cut = depth[: rows * PATCH, : columns * PATCH].reshape(rows, PATCH, columns, PATCH).swapaxes(1, 2)
    patches = cut.reshape(rows * columns, PATCH**2)
    seen, inverse = _inverse_depths(patches)
    usable = np.flatnonzero(seen.mean(axis=1) >= MIN_PATCH_RETURNS)
    if len(usable) < MIN_PATCHES:
        return 0.0, 0.0
    usable = usable[:: -(-len(usable) // MAX_PATCHES)]
    seen = seen[usable]
    inverse = inverse[usable]
    v, u = (np.indices((PATCH, PATCH)).reshape(2, -1) - (PATCH - 1) / 2) / PATCH
    basis = np.stack([np.ones(PATCH**2), u, v])
    products = (basis[:, None] * basis[None]).reshape(9, -1)
    errors = inverse
    spreads = np.zeros(len(seen))
    # fit a linear function of the pixel to the inverse depths of each patch, robustly
    for _ in range(FIT_ROUNDS):
        normal = (seen @ products.T).reshape(-1, 3, 3) + 1e-9 * np.eye(3)
        fit = np.linalg.solve(normal, ((seen * inverse) @ basis.T)[..., None])[..., 0]
        errors = inverse - fit @ basis
        middle = np.nanmedian(np.where(seen, np.abs(errors), np.nan), axis=1)
        spreads = np.sqrt((seen * errors**2).sum(axis=1) / np.maximum(seen.sum(axis=1) - 3, 1))
        seen = seen & (np.abs(errors) <= OUTLIER_SPREADS * 1.4826 * middle[:, None] + 1e-7)
    # the correlation of horizontal neighbors in the flattest patches
    flattest = np.argsort(spreads)[: int(FLAT_SHARE * len(spreads)) + 1]
    residuals = np.where(seen[flattest], errors[flattest], 0.0).reshape(-1, PATCH, PATCH)
    both = seen[flattest].reshape(-1, PATCH, PATCH)
    both = both[:, :, 1:] & both[:, :, :-1]
    products = (residuals[:, :, 1:] * residuals[:, :, :-1])[both]
    squares = (0.5 * (residuals[:, :, 1:] ** 2 + residuals[:, :, :-1] ** 2))[both]
    return float(spreads[flattest[-1]]), float(products.sum() / max(squares.sum(), 1e-30))


def correlation_length(neighbor_correlation: float) -> float:
    """The correlation length of errors [pixels], as in `DepthNoise`, for the correlation of the errors of
    neighboring pixels."""
    if neighbor_correlation <= np.exp(-2):
        return 0.0
    return float(1 / np.sqrt(-2 * np.log(min(neighbor_correlation, 0.98))))


EMPTY_EDGE = 6
"""Smallest width and height of a region without returns that may count as empty, in pixels of an image of
half the resolution. Dropouts at edges and on grazed surfaces are thinner."""
CUT_SHARE = 0.25
"""If the returns end along one row or column over this fraction of the image, the image counts as cropped,
since the edges of objects are hardly ever so straight."""
AT_RANGE = 0.8
"""Beyond this fraction of the range, returns may end because the surface leaves the range."""
TOO_NEAR = 0.3
"""A region without returns counts as a surface that is too near to be measured if returns beside it are
nearer than this [m] along at least NEAR_SHARE of its border."""
NEAR_SHARE = 0.05


def wide_regions(mask: Bool[ndarray, "*n"], width: int) -> Bool[ndarray, "*n"]:
    """The parts of a mask that are at least `width` wide along every axis: its morphological opening."""
    from scipy.ndimage import grey_opening

    return grey_opening(mask.view(np.uint8), width, mode="nearest").view(np.bool_)


def empty_regions(depth: DepthImage, reach: float | None = None, arm: Pixels | None = None) -> Pixels | None:
    """The pixels without a return (0 or NaN) where nothing seems to be in range: large regions at the border
    of the image with no near surface beside them. None if there is no such pixel, or the image is cropped.

    Regions that do not reach the border are left out, since they may be dark or reflecting surfaces. reach:
    the sensor's range [m], if known. It avoids a mistake: if a surface such as the floor leaves the range,
    returns end along one row, but the image is not cropped. arm: the pixels of the arm, which may be closer
    than TOO_NEAR.
    """
    no_return = ~(depth > 0)
    lost = no_return[::2, ::2]
    if not lost.any() or no_return.all():
        return None
    from scipy.ndimage import label

    large_regions = wide_regions(lost, EMPTY_EDGE)
    half = depth[::2, ::2]
    in_range = ~lost & (half < AT_RANGE * (np.inf if reach is None else reach))
    # The image counts as cropped if, counted from one of its four sides, the first row with returns well
    # within the range lies next to a large region in many columns.
    kinds = large_regions + 2 * in_range
    for rows in (kinds, kinds.T, kinds[::-1], kinds.T[::-1]):
        first = int((rows == 2).any(axis=1).argmax())
        if first and (rows[first - 1] + rows[first] == 3).mean() > CUT_SHARE:
            return None
    regions: Int32[ndarray, "h w"] = label(large_regions)[0]  # type: ignore[assignment,index]
    is_empty = np.zeros(int(regions.max()) + 1, np.bool_)
    for border in (regions[0], regions[-1], regions[:, 0], regions[:, -1]):
        is_empty[border] = True
    too_near = half < TOO_NEAR if arm is None else (half < TOO_NEAR) & ~arm[::2, ::2]
    # for each region, the number of returns beside it, and the number of those that are too near
    returns_beside = np.zeros((2, len(is_empty)))
    for labels, seen, close in ((regions, ~lost, too_near), (regions.T, ~lost.T, too_near.T)):
        for own, neighbor in ((slice(1, None), slice(-1)), (slice(-1), slice(1, None))):
            returns = seen[neighbor]
            for row, weights in enumerate((None, close[neighbor][returns])):
                returns_beside[row] += np.bincount(labels[own][returns], weights, len(is_empty))
    is_empty &= returns_beside[1] < NEAR_SHARE * returns_beside[0]
    is_empty[0] = False
    height, width = depth.shape
    empty = is_empty[regions].repeat(2, 0).repeat(2, 1)
    return empty[:height, :width] & no_return if is_empty.any() else None


GRAZED_WIDTH = 0.04
"""Width of the border around a surface in the image [m, at the surface's depth]. Pixels without a return in
this border do not show that the space beyond the surface is open: a board that is seen almost edge-on gives
no return either."""
DEPTH_FACTOR = 1.5
"""Surfaces whose depths differ by less than this factor get a border of the same number of pixels."""


def open_depth(depth: DepthImage, arm: Pixels, focal: float) -> DepthImage:
    """The depths to assume for pixels without a return where nothing seems to be in range.

    They are infinite, except within GRAZED_WIDTH of a surface other than the arm. There they are -d, where d
    is the smallest depth of such surfaces: only the space up to d is free; see `observed_volume`. focal:
    focal length [pixels].
    """
    from scipy.ndimage import minimum_filter

    half = depth[::2, ::2]
    surface = np.where((half >= NEAREST) & ~arm[::2, ::2], half, np.float32(np.inf))
    opening = np.full(half.shape, np.inf, np.float32)
    nearest = float(surface.min())
    while np.isfinite(nearest):
        layer = np.where(surface < DEPTH_FACTOR * nearest, surface, np.float32(np.inf))
        pixels = int(np.ceil(GRAZED_WIDTH * focal / nearest / 2))
        np.minimum(opening, minimum_filter(layer, 2 * pixels + 1, mode="nearest"), out=opening)
        surface[surface < DEPTH_FACTOR * nearest] = np.inf
        nearest = float(surface.min())
    opening = np.where(np.isfinite(opening), -opening, opening)
    height, width = depth.shape
    return opening.repeat(2, 0).repeat(2, 1)[:height, :width]


MIN_RETURN_SHARE = 1e-3
"""An image with a smaller fraction of returns counts as measuring nothing: the camera is covered, broken or
faces nothing."""


def shows_surface(view: DepthView) -> bool:
    """Whether at least MIN_RETURN_SHARE of an image's pixels measure a surface."""
    depth = filtered(view).depth
    return bool(((depth >= NEAREST) & np.isfinite(depth)).mean() >= MIN_RETURN_SHARE)


def measured_share(view: DepthView) -> float:
    """The fraction of an image's pixels that measure a surface, or show that nothing is in range; 0 for an
    image without a surface."""
    if not shows_surface(view):
        return 0.0
    measured = filtered(view).depth >= NEAREST
    empty = None if view.range is None else empty_regions(view.depth, view.range)
    return float((measured if empty is None else measured | empty).mean())


def measure_noise(images: Sequence[ArrayLike]) -> DepthNoise:
    """Measure the noise of a sensor on a few depth images of a still scene, for `DepthView.noise`.

    Args:
        images: Depth images [m], at least two of the same size, of a camera and a scene at rest.

    Returns:
        The spread and the correlation length, both measured between the images or both within flat patches
        of one image, whichever gives the larger spread; and the fraction of dropouts.

    Raises:
        InputError: For anything but a list of two or more images h x w of one size, if no pixel has a return
            in all images, if the depths cannot be in meters, and for a spread above 0.1 m.

    Examples:
        >>> rng = np.random.default_rng(0)
        >>> images = [1.0 + 0.002 * rng.standard_normal((48, 64)) for _ in range(5)]
        >>> round(rd.measure_noise(images).spread, 3)
        0.002
    """
    rows = images if isinstance(images, list | tuple) else np.atleast_1d(np.asarray(images))
    arrays = [numbers(image) for image in rows]
    forms = [*map(form, arrays)]
    if len(forms) < 2 or len({*forms}) > 1 or forms[0].count(" x ") != 1:
        raise InputError(f"images are {shown(forms)}; at least two images of one size, h x w, are needed")
    stack = np.array(arrays, np.float32)
    stack[stack > MAX_COORDINATE] = np.inf  # nothing in range, as in DepthView
    seen, inverse = _inverse_depths(stack)
    always = np.equal(seen.sum(axis=0), len(stack))
    if not always.any():
        raise InputError("images: no pixel has a return in all of them")
    middle = np.median(stack[seen])
    if middle > FARTHEST:
        raise InputError(f"images have depths about {middle:.4g}; they must be in meters")
    changes = (inverse - inverse.mean(axis=0)) * np.sqrt(len(stack) / (len(stack) - 1))
    both = always[:, 1:] & always[:, :-1]
    variances = (changes**2).mean(axis=0)
    over_time = float(np.sqrt(np.median(variances[always])))
    clipped = np.clip(changes, -3 * over_time, 3 * over_time)
    products = (clipped[:, :, 1:] * clipped[:, :, :-1])[:, both].sum()
    correlated = products / max((clipped**2)[:, always].mean() * len(stack) * both.sum(), 1e-30)
    still = [patch_noise(image) for image in stack]
    spread, neighbor_correlation = max((over_time, float(correlated)), *still)
    length = correlation_length(neighbor_correlation)
    missing = 1 - seen.sum() / max(len(stack) * int((seen.sum(axis=0) > 0).sum()), 1)
    with located("images"):
        return DepthNoise(spread=spread, missing=float(missing), correlation=length)


def pose_error(view: DepthView, distance: ArrayLike) -> Values:
    """How far the inexact pose of the camera may displace points at these distances from the camera [m]."""
    position, angle = view.pose_deviation
    return position + angle * np.asarray(distance)


PointErrors = Float[ndarray, "n 2"]
"""Two errors of each point [m]: how far the error of the camera's pose may displace it, which displaces
neighboring points alike; and the standard deviation of the noise."""


def point_errors(views: Iterable[DepthView], points: Points) -> PointErrors:
    """The errors of observed points, each the maximum over all views."""
    errors = np.zeros((len(points), 2))
    for view in views:
        distance = np.linalg.norm(points - view.T_base_camera[:3, 3], axis=1)
        noise = filtered(view).spread * distance**2
        errors = np.maximum(errors, np.column_stack([pose_error(view, distance), noise]))
    return errors


def grown_for_errors(spheres: Spheres, view: DepthView) -> Spheres:
    """The arm's spheres in the base frame, inflated by MARGIN_SPREADS times the noise of depth at their
    distance and by the error of the camera's pose."""
    T = view.T_base_camera
    offset = spheres[:, :3] - T[:3, 3]
    forward = np.maximum(offset @ T[:3, 2], 0.0)
    grown = spheres.copy()
    noise = MARGIN_SPREADS * filtered(view).edge_spread * forward**2
    grown[:, 3] += noise + pose_error(view, np.linalg.norm(offset, axis=1))
    return grown
