"""Spheres that cover convex solids, in milliseconds: for tools and for what a robot holds.

The solid is cut along its axes into a lattice of convex pieces, and each piece is held by a sphere around its
corners. So surface and inside are covered, provably. The fit of `sphere_fitting.py` needs about half as many
spheres for the same closeness, and takes seconds.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.fitting.sphere_fitting import MARGIN, SphereSettings

CLOSE = SphereSettings()
"""How closely spheres follow links."""
MOST = 100
"""Spheres of a solid: where they do not suffice, they stick out further."""
MOST_CUTS = 40
"""Pieces along an axis, at most."""
STEPS, ALL = 15, 0.999
"""Of the search for the smallest sphere around corners; it ends when all are at this share of the radius."""


def cover(mesh: ConvexMesh) -> Float[ndarray, "n 4"]:
    """Spheres [x y z radius, m] that hold all of a convex mesh, its inside too."""
    axes = _axes(mesh.vertices)
    vertices = mesh.vertices @ axes.T
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    whole = _around(vertices)
    if whole[3] - (high - low).min() / 2 <= _tolerance(high - low):
        spheres = whole[None]
    else:
        pieces = [vertices]
        for axis, count in enumerate(_lattice(high - low)):
            cuts = np.linspace(low[axis], high[axis], count + 1)[1:-1]
            pieces = [piece for whole in pieces for piece in _slices(whole, axis, cuts)]
        spheres = np.stack([_around(piece) for piece in pieces if len(piece)])
    return np.column_stack([spheres[:, :3] @ axes, spheres[:, 3] + MARGIN])


def _tolerance(size: Float[ndarray, "3"]) -> float:
    """How far spheres may stick out [m]: as those of a hand."""
    return max(min(CLOSE.second_half, CLOSE.relative * float(size.min()) / 2), CLOSE.finest)


def _axes(vertices: Float[ndarray, "v 3"]) -> Float[ndarray, "3 3"]:
    """The mesh's own axes, or the principal ones where a box along those is smaller; rows."""
    principal = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]
    own, other = np.ptp(vertices, axis=0).prod(), np.ptp(vertices @ principal.T, axis=0).prod()
    return principal if other < 0.9 * own else np.eye(3)


def _lattice(size: Float[ndarray, "3"]) -> tuple[int, ...]:
    """Pieces along each axis of a box: as few as keep to the tolerance, or the best of at most MOST."""
    counts = np.stack(np.meshgrid(*3 * [np.arange(1, MOST_CUTS + 1)], indexing="ij"), axis=-1).reshape(-1, 3)
    counts = counts[counts.prod(axis=1) <= MOST]
    half = size / counts / 2
    out = np.linalg.norm(half, axis=1) - half.min(axis=1)
    close = np.flatnonzero(out <= _tolerance(size))
    best = close[counts[close].prod(axis=1).argmin()] if len(close) else out.argmin()
    return tuple(counts[best].tolist())


def _slices(corners: Float[ndarray, "v 3"], axis: int, cuts: Float[ndarray, "c"]) -> list[ndarray]:
    """The corners of what lies between the cuts of the hull of corners."""
    slices = []
    for cut in cuts:
        below, above = corners[corners[:, axis] < cut], corners[corners[:, axis] > cut]
        level = corners[corners[:, axis] == cut]
        if len(below) and len(above):
            share = ((cut - below[:, axis])[:, None] / (above[:, axis] - below[:, axis, None]))[..., None]
            crossing = (below[:, None] + share * (above - below[:, None])).reshape(-1, 3)
            level = _outermost(np.concatenate([level, crossing]), axis)
        if len(below):
            slices.append(np.concatenate([below, level]))
        corners = np.concatenate([level, above])
    return [*slices, corners]


def _outermost(points: Float[ndarray, "n 3"], axis: int) -> Float[ndarray, "m 3"]:
    """The corners of the hull of points in a plane across an axis."""
    try:
        return points[ConvexHull(np.delete(points, axis, axis=1)).vertices]
    except QhullError:  # in a line, or one point
        return np.unique(points, axis=0)


def _around(points: Float[ndarray, "n 3"]) -> Float[ndarray, "4"]:
    """A small sphere around points: the best of the middle of their box and some steps of Badoiu and
    Clarkson."""
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    best = np.array([*center, np.inf])
    for i in range(1, STEPS):
        far = np.linalg.norm(points - center, axis=1)
        if far.max() < best[3]:
            best = np.array([*center, far.max()])
        if far.min() > ALL * far.max():
            break
        center = center + (points[far.argmax()] - center) / (i + 1)
    return best
