"""Covers convex solids, such as tools and held objects, with spheres in milliseconds.

The solid is cut along its axes into a lattice of convex pieces, and each piece gets a sphere around its
corners. So the spheres provably cover surface and interior. The fit in `sphere_fitting.py` needs about half
as many spheres for the same tolerance, but takes seconds.

`Robot.attach` and `Robot.with_tool` add a body to a robot as one more link. The link has convex meshes for
the validator and covering spheres for planning, and is checked against other links. The joints stay the same,
so network weights trained for the bare arm can still be used.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from robotdiffuse.core.transforms import ball_around, box_around, inverse, moved_spheres, placed
from robotdiffuse.core.types import NO_SPHERES, Points, Rotation, Spheres, Values, Vector
from robotdiffuse.robots.bodies import AttachedBody, ConvexMesh
from robotdiffuse.robots.fitting.sphere_fitting import MARGIN, SphereSettings

LINK_TOLERANCES = SphereSettings()
"""Tolerances of the spheres of a robot's links, used for attached bodies too."""
HAND = (1, 0)
"""Arguments `frame` and `dof` of `SphereSettings.tolerance` for a body at the end of an arm."""
MAX_SPHERES = 100
"""Largest number of spheres for each solid; if they do not suffice, the spheres exceed the tolerance."""
MAX_PIECES_PER_AXIS = 40
BOUNDING_STEPS = 15
"""Largest number of centers that the search for a small sphere around points tries, plus one."""
EQUIDISTANT = 0.999
"""The search for a small sphere ends when the nearest point is at least this fraction of the radius away from
the center."""


def cover(mesh: ConvexMesh) -> Spheres:
    """Spheres [x y z radius, m] that cover surface and interior of a convex mesh."""
    axes = _axes(mesh.vertices)
    vertices = mesh.vertices @ axes.T
    low, high = box_around(vertices)
    half_width = float((high - low).min()) / 2  # at least the radius of the largest inscribed sphere
    tolerance = LINK_TOLERANCES.tolerance(*HAND, half_width)
    bounding = _around(vertices)
    if bounding[3] - half_width <= tolerance:
        spheres = bounding[None]
    else:
        pieces = [vertices]
        for axis, count in enumerate(_lattice(high - low, tolerance)):
            cuts = np.linspace(low[axis], high[axis], count + 1)[1:-1]
            pieces = [slab for piece in pieces for slab in _slices(piece, axis, cuts)]
        spheres = np.stack([_around(piece) for piece in pieces if len(piece)])
    return np.column_stack([spheres[:, :3] @ axes, spheres[:, 3] + MARGIN])


def _axes(vertices: Points) -> Rotation:
    """Axes of the lattice, as rows: the principal axes if a box along them is clearly smaller, else the axes
    of the mesh's frame."""
    principal = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]
    frame_volume = np.ptp(vertices, axis=0).prod()
    principal_volume = np.ptp(vertices @ principal.T, axis=0).prod()
    return principal if principal_volume < 0.9 * frame_volume else np.eye(3)


def _lattice(size: Vector, tolerance: float) -> tuple[int, ...]:
    """Number of pieces along each axis: the fewest pieces with spheres within the tolerance. If MAX_SPHERES
    pieces do not suffice, the numbers with which the spheres stick out least."""
    counts = np.indices(3 * [MAX_PIECES_PER_AXIS]).reshape(3, -1).T + 1
    counts = counts[counts.prod(axis=1) <= MAX_SPHERES]
    half = size / counts / 2
    stick_out = np.linalg.norm(half, axis=1) - half.min(axis=1)
    close = np.flatnonzero(stick_out <= tolerance)
    best = close[counts[close].prod(axis=1).argmin()] if len(close) else stick_out.argmin()
    return tuple(counts[best].tolist())


def _slices(corners: Points, axis: int, cuts: Values) -> list[ndarray]:
    """Cuts the convex hull of `corners` at coordinates along an axis; returns the corners of each slice."""
    slices = []
    for cut in cuts:
        below = corners[corners[:, axis] < cut]
        above = corners[corners[:, axis] > cut]
        level = corners[corners[:, axis] == cut]
        if len(below) and len(above):
            share = ((cut - below[:, axis])[:, None] / (above[:, axis] - below[:, axis, None]))[..., None]
            crossing = (below[:, None] + share * (above - below[:, None])).reshape(-1, 3)
            level = _outermost(np.concatenate([level, crossing]), axis)
        if len(below):
            slices.append(np.concatenate([below, level]))
        corners = np.concatenate([level, above])
    return [*slices, corners]


def _outermost(points: Points, axis: int) -> Points:
    """Corners of the hull of points in a plane perpendicular to an axis."""
    try:
        return points[ConvexHull(np.delete(points, axis, axis=1)).vertices]
    except QhullError:  # collinear points, or one point
        return np.unique(points, axis=0)


def _around(points: Points) -> Float[ndarray, "4"]:
    """A small sphere around points. Badoiu and Clarkson's algorithm moves the center, beginning at the center
    of the points' box; the smallest sphere found is returned."""
    center, _ = ball_around(points)
    best = np.array([*center, np.inf])
    for i in range(1, BOUNDING_STEPS):
        distances = np.linalg.norm(points - center, axis=1)
        if distances.max() < best[3]:
            best = np.array([*center, distances.max()])
        if distances.min() > EQUIDISTANT * distances.max():
            break
        center = center + (points[distances.argmax()] - center) / (i + 1)
    return best


def body_geometry(body: AttachedBody) -> tuple[tuple[ConvexMesh, ...], Spheres]:
    """Convex meshes of a body and spheres [x y z radius, m] that cover them, in the body's frame."""
    T_body_link = inverse(body.T_link_body)
    meshes = list[ConvexMesh]()
    spheres: list[ndarray] = [NO_SPHERES]
    for shape in body.shapes:
        T_link_shape, parts = shape.solid()
        T = T_body_link @ T_link_shape
        for part in parts:
            meshes.append(ConvexMesh(placed(T, part.vertices), part.faces))
            spheres.append(moved_spheres(T, cover(part)))
    return tuple(meshes), np.concatenate(spheres)
