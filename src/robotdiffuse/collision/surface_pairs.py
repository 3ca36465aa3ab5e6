"""Distances between the mesh surfaces of two grazing links: links whose convex parts can overlap although the
links do not touch.

Convex parts fill hollows of a mesh. Where the parts of two links overlap only a little, the triangles of the
URDF's meshes decide whether the links collide: the triangles must not touch, and no piece of one link may lie
inside the other. The distance of the surfaces then bounds how far the links can move without contact, since a
piece cannot get inside without touching the surface.
"""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass

import coal
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.collision.convex_geometry import Check, checks_of, surfaces_decide
from robotdiffuse.core.transforms import placed
from robotdiffuse.robots.coal_geometry import coal_pose, coal_surface
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.robots.robot import Robot

MAX_OVERLAP = 0.005
"""Overlap of convex parts beyond which links count as colliding, without a test of their surfaces [m]."""
RAYS = np.array([[0.6137, 0.5291, 0.5861], [-0.7313, 0.3917, -0.5583], [0.1723, -0.8839, 0.4348]])
"""Directions of the rays that tell whether a point is inside a surface; oblique, so that few rays run along
an edge or a face."""


@dataclass(frozen=True, eq=False)
class _Body:
    """The surface of a link, in the frame that the link is fixed to."""

    frame: int
    tree: "coal.BVHModelOBBRSS"
    triangles: Float[ndarray, "f 3 3"]
    component: Int[ndarray, "f"]
    """Connected component of each triangle."""
    points: Float[ndarray, "components 3"]
    """One point of each component."""

    def inside(self, points: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether each point may be inside a connected component: one of several rays from the point crosses
        the component an odd number of times. Points in front of an open component can count as inside."""
        low = self.triangles.min(axis=(0, 1))
        high = self.triangles.max(axis=(0, 1))
        enclosed = ((points >= low) & (points <= high)).all(axis=1)
        for i in np.flatnonzero(enclosed):
            enclosed[i] = any((np.bincount(self._crossed(points[i], ray)) % 2).any() for ray in RAYS)
        return enclosed

    def _crossed(self, point: Float[ndarray, "3"], ray: Float[ndarray, "3"]) -> Int[ndarray, "k"]:
        """Component of every triangle that a ray from a point crosses."""
        a, b, c = np.moveaxis(self.triangles - point, 1, 0)
        sides = [np.cross(edge_start, edge_end) @ ray for edge_start, edge_end in ((a, b), (b, c), (c, a))]
        through = np.all([side >= 0 for side in sides], axis=0) | np.all([side < 0 for side in sides], axis=0)
        normal = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            along = np.einsum("fd,fd->f", normal, a) / (normal @ ray)
        return self.component[through & (along > 0)]


@dataclass(frozen=True, eq=False)
class SurfacePair:
    """The surfaces of two links."""

    first: _Body
    second: _Body

    def distance(self, frames: Float[ndarray, "frames 4 4"], cutoff: float = np.inf) -> float | None:
        """Distance of the surfaces [m]; if the distance is larger than `cutoff`, some value of at least
        `cutoff`. None if the surfaces touch, or a piece of one is inside the other."""
        a = self.first
        b = self.second
        T_a = frames[a.frame]
        T_b = frames[b.frame]
        places = a.tree, coal_pose(T_a), b.tree, coal_pose(T_b)
        if coal.collide(*places, coal.CollisionRequest(), coal.CollisionResult()):
            return None
        for body, T_body, other_body, T_other in ((a, T_a, b, T_b), (b, T_b, a, T_a)):
            in_base = placed(T_other, other_body.points)
            if body.inside((in_base - T_body[:3, 3]) @ T_body[:3, :3]).any():
                return None
        result = coal.DistanceResult()
        if np.isfinite(cutoff):
            result.min_distance = cutoff
        return float(coal.distance(*places, coal.DistanceRequest(), result))


@once_per_robot
def surface_pairs(robot: Robot) -> dict[Check, SurfacePair]:
    """The surfaces of each checked pair of grazing links."""
    bodies: dict[str, _Body] = {}
    surfaces = {}
    for check in checks_of(robot):
        if check.other is None or not surfaces_decide(robot, check):
            continue
        for link in (check.link, check.other):
            if link not in bodies:
                bodies[link] = _body(robot, link)
        surfaces[check] = SurfacePair(bodies[check.link], bodies[check.other])
    return surfaces


def _body(robot: Robot, link: str) -> _Body:
    from scipy.sparse import coo_array  # few robots need it
    from scipy.sparse.csgraph import connected_components

    T = robot.T_frame_link(link)
    surface = robot.surfaces[link]
    vertices = placed(T, surface.vertices)
    faces = surface.faces
    edge_ends = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    edges = coo_array((np.ones(len(edge_ends[0]), bool), edge_ends), (len(vertices),) * 2)
    _, vertex_component = connected_components(edges, directed=False)
    _, first, component = np.unique(vertex_component[faces[:, 0]], return_index=True, return_inverse=True)
    points = vertices[faces[first, 0]]
    return _Body(robot.link_frame(link), coal_surface(vertices, faces), vertices[faces], component, points)
