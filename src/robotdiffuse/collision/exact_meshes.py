"""Exact distances between the robot's convex meshes and the scene, by Coal: the validator's geometry.

This geometry does not depend on the covering spheres, so the spheres can be tested against it. Only a link
without meshes is represented by its spheres. Distances are signed [m]: the negative penetration depth inside.

Convex parts fill hollows of a mesh. Where the parts of two grazing links (`Robot.grazing`) nearly touch
or overlap a little, the triangles of the URDF's meshes decide whether the links collide (`SurfacePair`): the
triangles must not touch, and no component of one surface may lie inside the other. The distance of the
surfaces then bounds how far the links can move without contact, since a component cannot get inside without
touching the surface.
"""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import NamedTuple

import coal
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.collision.convex_geometry import (
    SURFACES_BELOW,
    Check,
    Part,
    Solid,
    checks_of,
    describe_contact,
    hulls_of,
    parts_of,
    solid_arrays,
    solids_of,
)
from robotdiffuse.collision.kernels import mesh_bounds as kernel
from robotdiffuse.core.deadline import check_time
from robotdiffuse.core.transforms import placed, seen_from, transform
from robotdiffuse.core.types import (
    Configuration,
    Points,
    Pose,
    Poses,
    Spheres,
    Vector,
    for_kernels,
    frozen_dataclass,
)
from robotdiffuse.robots.coal_geometry import coal_convex, coal_pose, coal_rounded, coal_surface
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud, Sphere, Triangulated

MAX_OVERLAP = 0.005
"""Overlap of convex parts beyond which links count as colliding, without a test of their surfaces [m]."""
RAYS = np.array([[0.6137, 0.5291, 0.5861], [-0.7313, 0.3917, -0.5583], [0.1723, -0.8839, 0.4348]])
"""Directions of the rays that tell whether a point is inside a surface; oblique, so that few rays run along
an edge or a face."""


@frozen_dataclass
class _Body:
    """The surface of a link, in the frame that the link is fixed to."""

    frame: int
    tree: "coal.BVHModelOBBRSS"
    triangles: Float[ndarray, "f 3 3"]
    component: Int[ndarray, "f"]
    """Connected component of each triangle."""
    points: Points
    """One point of each component."""

    def inside(self, points: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether each point may be inside a connected component: one of several rays from the point crosses
        the component an odd number of times. Points in front of an open component can count as inside."""
        low = self.triangles.min(axis=(0, 1))
        high = self.triangles.max(axis=(0, 1))
        enclosed = ((points >= low) & (points <= high)).all(axis=1)
        for i in np.flatnonzero(enclosed):
            # `bincount` counts the crossings of each component
            enclosed[i] = any((np.bincount(self._crossed(points[i], ray)) % 2).any() for ray in RAYS)
        return enclosed

    def _crossed(self, point: Vector, ray: Vector) -> Int[ndarray, "k"]:
        """Component of every triangle that a ray from a point crosses."""
        a, b, c = np.moveaxis(self.triangles - point, 1, 0)
        # the ray's line crosses a triangle if it passes all three edges on the same side
        sides = [np.cross(edge_start, edge_end) @ ray for edge_start, edge_end in ((a, b), (b, c), (c, a))]
        through = np.all([side >= 0 for side in sides], axis=0) | np.all([side < 0 for side in sides], axis=0)
        normal = np.cross(b - a, c - a)
        with np.errstate(all="ignore"):
            along = np.einsum("fd,fd->f", normal, a) / (normal @ ray)
        return self.component[through & (along > 0)]


@frozen_dataclass
class SurfacePair:
    """The surfaces of two links."""

    first: _Body
    second: _Body

    def distance(self, frames: Poses, cutoff: float = np.inf) -> float | None:
        """Distance of the surfaces [m]; if the distance is larger than `cutoff`, some value of at least
        `cutoff`. None if the surfaces touch, or a component of one is inside the other."""
        a = self.first
        b = self.second
        T_a = frames[a.frame]
        T_b = frames[b.frame]
        places = a.tree, coal_pose(T_a), b.tree, coal_pose(T_b)
        if coal.collide(*places, coal.CollisionRequest(), coal.CollisionResult()):
            return None
        for body, T_body, other_body, T_other in ((a, T_a, b, T_b), (b, T_b, a, T_a)):
            if body.inside(seen_from(T_body, placed(T_other, other_body.points))).any():
                return None
        result = coal.DistanceResult()
        if np.isfinite(cutoff):
            result.min_distance = cutoff
        return float(coal.distance(*places, coal.DistanceRequest(), result))


@once_per_robot
def surface_pairs(robot: Robot) -> dict[Check, SurfacePair]:
    """The surfaces of each checked pair of grazing links."""
    bodies = dict[str, _Body]()
    surfaces = {}
    for check in checks_of(robot):
        if check.other is None or frozenset(check) not in robot.grazing:
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


RESTING_DEPTH = 0.01
"""If a held object penetrates an obstacle less deeply, the message says how to allow the contact [m]."""
MAX_CONTACTS = 200
"""Largest number of triangles or points of one obstacle from which the penetration of a link is computed;
1,000 would take 5 ms."""


class Distance(NamedTuple):
    """Signed distance [m] of a link to the nearest obstacle or to another link. `other` names this
    obstacle or link; None in an empty scene."""

    link: str
    other: str | None
    distance: float


class _Piece(NamedTuple):
    """A convex part of a link as a Coal object."""

    geometry: coal.CollisionGeometry
    frame: int
    T_frame_piece: Pose | None
    """None if the geometry is given in the frame already."""

    def pose(self, frames: ndarray) -> coal.Transform3s:
        """Its pose in the base frame, as Coal takes it."""
        T = frames[self.frame]
        return coal_pose(T if self.T_frame_piece is None else T @ self.T_frame_piece)


TREE_SECONDS_PER_ELEMENT = 4e-6
"""Approximate time in which Coal adds one point or triangle to its bounding volume tree [s]."""


class _Obstacle(NamedTuple):
    """A scene shape as a Coal object."""

    name: str
    geometry: coal.CollisionGeometry
    T: coal.Transform3s
    surface: bool
    """Whether it is a triangle mesh or a point cloud rather than a solid."""
    inflation: float
    """The radius of each point of a point cloud [m]."""


def forward_frames(robot: Robot, q: Float[ndarray, "*batch dof"]) -> Float[ndarray, "*batch frames 4 4"]:
    """T_base_frame of frames 0 to dof at each configuration, in float64 and independent of the PyTorch
    kinematics."""
    T = kernel.forward(*robot.kernel_joints, for_kernels(q.reshape(-1, robot.dof)))
    return T.reshape(*q.shape[:-1], *T.shape[1:])


def _piece(part: Part) -> _Piece:
    if len(part.faces):
        return _Piece(coal_convex(part.vertices, part.faces), part.frame, None)
    return _Piece(coal.Sphere(part.rounding), part.frame, transform(part.center))


@once_per_robot
def _pieces(robot: Robot) -> dict[str, tuple[_Piece, ...]]:
    return {link: tuple(map(_piece, parts)) for link, parts in parts_of(robot).items()}


def _balls(robot: Robot, link: str) -> tuple[int, Spheres]:
    """The frame of a link, and balls around its parts."""
    hulls, parts = hulls_of(robot)
    return robot.link_frame(link), hulls.balls[parts[link].start : parts[link].stop]


def _obstacle(solid: Solid) -> _Obstacle:
    """The Coal object of a shape."""
    shape = solid.shape
    if isinstance(shape, Triangulated | PointCloud):  # given in the base frame
        return _Obstacle(shape.name, _tree(shape), coal.Transform3s.Identity(), True, solid.rounding)
    geometry = coal_rounded(solid.half, solid.disc, solid.rounding)
    return _Obstacle(shape.name, geometry, coal_pose(solid.T_base_box), False, 0.0)


@lru_cache(maxsize=16)
def _tree(shape: Triangulated | PointCloud) -> coal.BVHModelOBBRSS:
    """Coal's bounding volume tree over a surface or a point cloud. It is cached because scenes share shapes,
    and 100,000 points take 0.4 s."""
    if isinstance(shape, PointCloud):
        # Each point is a triangle of zero size: Coal's tree then prunes 100,000 points in about 0.1 ms.
        vertices = shape.distinct_points
        elements = "points"
        faces = np.repeat(np.arange(len(vertices))[:, None], 3, axis=1)
    else:
        vertices = shape.mesh.world_vertices
        faces = shape.mesh.faces
        elements = "triangles"
    check_time(
        f"the validator's tree over the {len(faces):,} {elements} of {shape.name}",
        TREE_SECONDS_PER_ELEMENT * len(faces),
    )
    return coal_surface(vertices, faces)


@lru_cache(maxsize=16)
def _obstacles(scene: Scene) -> tuple[_Obstacle, ...]:
    """The Coal objects of a scene, cached."""
    return tuple(map(_obstacle, solids_of(scene)))


class _Candidates(NamedTuple):
    """The pairs of geometries that a check compares: each of `firsts`, the convex parts of a link, with each
    of `seconds`, obstacles or the convex parts of another link."""

    firsts: tuple[_Piece, ...]
    seconds: tuple[_Piece | _Obstacle, ...]
    lower: Callable[[ndarray], ndarray]
    """Lower bounds [n, firsts * seconds] of the signed distances [m], from frames [n, dof + 1, 4, 4]."""

    surfaces: SurfacePair | None = None
    """Mesh surfaces of two grazing links; None if only the convex parts are compared."""

    def pair(self, index: int) -> tuple[_Piece, _Piece | _Obstacle]:
        return self.firsts[index // len(self.seconds)], self.seconds[index % len(self.seconds)]


class ExactCollision:
    """Signed distances and collisions of a robot's exact meshes with a scene and among the links.

    Links that no planned joint moves are checked only against moving links. Threads may share an object of
    this class, since calls do not change it.
    """

    checks: tuple[Check, ...]
    """Moving links against the scene, then the pairs of links."""

    def __init__(self, robot: Robot, scene: Scene) -> None:
        self.robot, self._solids = robot, solid_arrays(robot, scene)
        self._pieces, self._obstacles = _pieces(robot), _obstacles(scene)
        self.checks = checks_of(robot)
        self._request = coal.DistanceRequest()
        self._request.enable_signed_distance = True
        self._first_contact, self._contacts = coal.CollisionRequest(), coal.CollisionRequest()
        self._first_contact.enable_contact = self._contacts.enable_contact = True
        self._contacts.num_max_contacts = MAX_CONTACTS

    @cached_property
    def _candidates(self) -> tuple[_Candidates, ...]:
        return tuple(map(self._candidates_of, range(len(self.checks))))

    def _candidates_of(self, check: int) -> _Candidates:
        link, against = self.checks[check]
        firsts = self._pieces[link]
        balls = _balls(self.robot, link)
        if against is None:
            solids = self._solids
            return _Candidates(
                firsts, self._obstacles, lambda frames: kernel.scene_bounds(frames, *balls, solids, check)
            )
        balls_against = _balls(self.robot, against)
        return _Candidates(
            firsts,
            self._pieces[against],
            lambda frames: kernel.pair_bounds(frames, *balls, *balls_against),
            surface_pairs(self.robot).get(self.checks[check]),
        )

    def _signed(
        self, piece: _Piece, other: _Piece | _Obstacle, frames: ndarray, cutoff: float, depth: bool
    ) -> float:
        """Signed distance of two geometries [m]. For a surface farther away than `cutoff`, the result is some
        value of at least `cutoff`.

        Without `depth`, the penetration of a surface may be too small, but the sign is right.
        """
        other_pose = other.pose(frames) if isinstance(other, _Piece) else other.T
        places = piece.geometry, piece.pose(frames), other.geometry, other_pose
        result = coal.DistanceResult()
        if isinstance(other, _Piece) or not other.surface:
            return coal.distance(*places, self._request, result)
        # For a penetrated surface, Coal's distance query is slow and returns the depth at an arbitrary
        # triangle, so the contacts are computed first.
        request = self._contacts if depth else self._first_contact
        hits = coal.CollisionResult()
        coal.collide(*places, request, hits)
        if hits.isCollision():
            contacts = map(hits.getContact, range(hits.numContacts()))
            # Coal's penetration depths are negative
            return min([0.0, *(contact.penetration_depth for contact in contacts)]) - other.inflation
        if np.isfinite(cutoff):
            result.min_distance = cutoff + other.inflation
        return coal.distance(*places, self._request, result) - other.inflation

    def nearest(
        self,
        q: Float[ndarray, "n dof"],
        checks: Int[ndarray, "n"],
        cutoffs: Float[ndarray, "n"],
        stop: float = -np.inf,
    ) -> tuple[Float[ndarray, "n"], list[str | None]]:
        """Signed distance of the check `self.checks[checks[i]]` at each configuration q[i], at most
        cutoffs[i] [m].

        Also returns the name of the nearest obstacle or link, None beyond the cutoff. Rows are processed in
        order up to the first distance of at most `stop`. The depth of that row may be too small, and later
        distances are NaN.
        """
        frames = forward_frames(self.robot, q)
        distances = np.full(len(q), np.nan)
        names: list[str | None] = [None] * len(q)
        for i, (check, cutoff) in enumerate(zip(checks.tolist(), cutoffs.tolist(), strict=True)):
            distances[i], obstacle = self._distance(self._candidates[check], frames[i], cutoff, stop)
            if distances[i] < cutoff:
                names[i] = self.checks[check].other or obstacle
            if distances[i] <= stop:
                break
        return distances, names

    def _distance(
        self, candidates: _Candidates, frames: ndarray, cutoff: float, stop: float
    ) -> tuple[float, str | None]:
        """Signed distance of a check [m], at most `cutoff`, and the name of the nearest obstacle, None for
        two links. The search ends at the first distance of at most `stop`. Unless `stop` is -inf, the
        penetration of a surface may be too small, but the sign is right.

        The distance is the smallest of all pairs of geometries. For two grazing links, it is the distance of
        their mesh surfaces if that is larger. The surfaces count only if the signed distance of the convex
        parts is between -MAX_OVERLAP and SURFACES_BELOW, and if the surfaces neither touch nor enclose a
        component of each other.
        """
        surfaces = candidates.surfaces
        enough = stop if surfaces is None else min(stop, -MAX_OVERLAP)
        best = cutoff
        obstacle = None
        lower = candidates.lower(frames[None])[0]
        for candidate in lower.argsort().tolist():
            if lower[candidate] >= best or best <= enough:
                break
            piece, partner = candidates.pair(candidate)
            distance = self._signed(piece, partner, frames, best, depth=stop == -np.inf)
            if distance < best:
                best = distance
                obstacle = partner.name if isinstance(partner, _Obstacle) else None
        if surfaces is not None and -MAX_OVERLAP < best < SURFACES_BELOW:
            surface_distance = surfaces.distance(frames, cutoff)
            best = best if surface_distance is None else min(max(best, surface_distance), cutoff)
        return best, obstacle

    def distances(self, q: Configuration) -> tuple[Distance, ...]:
        """Signed distances [m]: of every moving link to the nearest obstacle, infinite in an empty scene;
        then of every checked pair of links, negative where they overlap."""
        count = len(self.checks)
        distances, names = self.nearest(np.tile(q, (count, 1)), np.arange(count), np.full(count, np.inf))
        return tuple(
            Distance(check.link, name, distance)
            for check, name, distance in zip(self.checks, names, distances.tolist(), strict=True)
        )

    def distance_from_moved_base(self, link: str, q: Configuration, T: Pose) -> float:
        """Signed distance of a link to the nearest obstacle [m] after the whole robot, base included, is
        moved by T. This equals the distance to obstacles that are moved by the inverse of T."""
        frames = T @ forward_frames(self.robot, q)
        return min(
            self._signed(piece, obstacle, frames, np.inf, depth=True)
            for piece in self._pieces[link]
            for obstacle in self._obstacles
        )

    def collides(self, q: Float[ndarray, "n dof"]) -> Bool[ndarray, "n"]:
        """Whether each configuration touches the scene or itself."""
        frames = forward_frames(self.robot, q)
        hit = np.zeros(len(q), bool)
        for candidates in self._candidates:
            near = (candidates.lower(frames) <= 0).any(axis=1)
            for row in np.flatnonzero(near & ~hit):
                hit[row] = self._distance(candidates, frames[row], SURFACES_BELOW, 0.0)[0] <= 0
        return hit


@once_per_robot
def warm_up(robot: Robot) -> None:
    """Load Coal and build the robot's Coal objects now, so that later calls do not spend their time limit on
    this."""
    explain_collision(robot, Scene([Sphere([0.0, 0.0, 100.0], 1.0)]), robot.middle)


def contacts_at(robot: Robot, scene: Scene, q: Configuration) -> list[Distance]:
    """The links that touch an obstacle or another link at a configuration, the deepest contact first."""
    checks = ExactCollision(robot, scene).distances(q)
    return sorted((check for check in checks if check.distance <= 0), key=lambda check: check.distance)


def explain_collision(robot: Robot, scene: Scene, q: Configuration) -> str | None:
    """The deepest collision at a configuration in words: 'panda_link5 is 3.2 cm inside sphere_2'.

    None if the exact meshes are free of collision.
    """
    contacts = contacts_at(robot, scene, q)
    return contact_message(robot, contacts[0]) if contacts else None


def contact_message(robot: Robot, contact: Distance) -> str:
    """A contact in words."""
    link, partner, distance = contact
    itself = partner in robot.link_names
    message = describe_contact(link, str(partner), -distance, itself)
    if not itself and -distance < RESTING_DEPTH and link in [body.name for body in robot.attached]:
        message += f"; if it stands there, name it in allowed_contacts of {partner}"
    return message
