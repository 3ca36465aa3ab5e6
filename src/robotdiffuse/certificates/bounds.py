"""The bounds that proofs consist of: clearances and displacements over stretches (intervals) of a motion.

A claim is that a link is free of the scene or of another link. A stretch is free for a claim if the clearance
of the link in the middle of the stretch exceeds its displacement: the largest distance of any point of the
link, anywhere on the stretch, from its place in the middle. Clearances are those of the robot's covering
spheres, or those of its convex meshes by separating planes. For two links, only joints that move exactly one
of the links count: the joints after the last joint that moves both links.

The geometry is the checker's own: distances of points to obstacles, and support functions of obstacles.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.certificates.kinematics import Linkage, Postures
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import ball_around, placed_each, rotation_from_quaternion
from robotdiffuse.core.types import (
    NO_SPHERES,
    Configurations,
    JointRows,
    JointValues,
    Points,
    Pose,
    Poses,
    Rotation,
    Spheres,
    Values,
    Vector,
    frozen_dataclass,
)
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import MovingObstacle, Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere, Triangulated

CLEARANCE_CAP = 1.0
"""Larger clearances count as this [m]."""
PLANE_RANGE = 0.2
"""Triangles and points farther than this from the ball around a part need no planes, and count as this far
away [m]."""
EXACT_TRIANGLE_RANGE = 4.0
"""A triangle is replaced by the ball around it at distances of more than this many radii of the ball."""
MAX_ARRAY_SIZE = 1_000_000
"""Approximate largest number of elements of a temporary array."""


class Rounded(NamedTuple):
    """The Minkowski sum of a box, a disc in the box's x-y plane and a ball. Each size may be 0, so this is a
    sphere, box, cylinder or capsule."""

    center: Vector
    R: Rotation
    """Rotation of the box in the base frame."""
    half: Vector
    """Half edge lengths of the box [m]."""
    disc: float
    """Radius of the disc [m]."""
    rounding: float
    """Radius of the ball [m]."""

    def reach(self, n: Points) -> Values:
        """The support function: the maximum of n · x over the body's points x, for each unit vector n."""
        local = n @ self.R
        across = np.hypot(local[:, 0], local[:, 1])
        return n @ self.center + np.abs(local) @ self.half + self.disc * across + self.rounding


@frozen_dataclass
class Surface:
    """Triangles or points, inflated by a radius, with a spatial index."""

    corners: Float[ndarray, "m corners 3"]
    radius: float

    def reach(self, n: Float[ndarray, "k 3"]) -> Float[ndarray, "m k"]:
        """The support function of each element: the maximum of n · x over its points x, for each unit vector
        n."""
        return (self.corners @ n.T).max(axis=1) + self.radius

    @cached_property
    def _groups(self) -> list[tuple[Any, ndarray, float]]:
        """Groups of elements of similar size. For each group: a tree of the elements' middles, their rows,
        and the radius of balls about the middles that contain them."""
        from scipy.spatial import KDTree  # imported here: it would double the import time of the checker

        middles = self.corners.mean(axis=1)
        sizes = np.linalg.norm(self.corners - middles[:, None], axis=-1).max(axis=1)
        octaves = np.ceil(np.log2(np.maximum(sizes, 1e-6))).astype(int)
        members = [np.flatnonzero(octaves == octave) for octave in np.unique(octaves)]
        return [(KDTree(middles[rows]), rows, float(sizes[rows].max())) for rows in members]

    def distances(self, points: Points) -> Values:
        """Lower bounds of the distances of points to the surface [m], at most CLEARANCE_CAP. They are exact
        if the elements are points, and for near triangles; farther triangles are replaced by balls around
        them."""
        nearest = np.full(len(points), CLEARANCE_CAP)
        for tree, rows, size in self._groups:
            to_middle = tree.query(points)[0]
            near = (to_middle < EXACT_TRIANGLE_RANGE * size) & (to_middle - size < nearest)
            nearest = np.minimum(nearest, np.where(near, np.inf, to_middle - size))
            near_points = np.flatnonzero(near)
            within = tree.query_ball_point(points[near_points], to_middle[near_points] + size)
            counts = np.array([len(some) for some in within], int)
            for some in np.array_split(np.arange(len(near_points)), counts.sum() * 9 // MAX_ARRAY_SIZE + 1):
                if len(some):
                    point_rows = np.repeat(near_points[some], counts[some])
                    triangles = self.corners[rows[np.concatenate(within[some]).astype(int)]]
                    np.minimum.at(nearest, point_rows, _to_triangles(points[point_rows], triangles))
        return nearest - self.radius

    def near(self, center: Vector, reach: float) -> "Surface":
        """The elements that come within `reach` [m] of a point, and possibly others."""
        reach += self.radius
        element_rows = [
            rows[tree.query_ball_point(center, reach + size)] for tree, rows, size in self._groups
        ]
        return Surface(self.corners[np.sort(np.concatenate(element_rows).astype(int))], self.radius)


class Obstacles:
    """The obstacles of a scene."""

    def __init__(self, scene: Scene) -> None:
        """Raises InputError if the scene has a shape that certificates do not support."""
        shapes = [s for s in scene.shapes if not (isinstance(s, PointCloud) and len(s.points) == 0)]
        self.names = tuple(shape.name for shape in shapes)
        self.bodies: tuple[Rounded | Surface, ...] = tuple(map(_body, shapes))
        rounded = [(i, body) for i, body in enumerate(self.bodies) if isinstance(body, Rounded)]
        self._at = np.array([i for i, _ in rounded], int)
        # rotations and translations by which points are transformed to the frames of all bodies at once
        self._turns = np.concatenate([np.zeros((3, 0)), *(body.R for _, body in rounded)], axis=1)
        self._shifts = np.concatenate([np.zeros(0), *(body.center @ body.R for _, body in rounded)])
        self._half = np.array([body.half for _, body in rounded]).reshape(-1, 3)
        self._disc = np.array([body.disc for _, body in rounded])
        self._rounding = np.array([body.rounding for _, body in rounded])

    def distances(self, points: Points) -> Float[ndarray, "n obstacles"]:
        """Distances of points to each obstacle [m], or lower bounds of them, at most CLEARANCE_CAP; 0 or less
        inside, except inside a mesh, of which only the surface counts."""
        distances_to_each = np.full((len(points), len(self.bodies)), CLEARANCE_CAP)
        step = max(MAX_ARRAY_SIZE // max(3 * len(self._at), 1), 1)
        for first in range(0, len(points), step):
            some = slice(first, first + step)
            distances_to_each[some, self._at] = np.minimum(self._to_rounded(points[some]), CLEARANCE_CAP)
        for i, body in enumerate(self.bodies):
            if isinstance(body, Surface):
                distances_to_each[:, i] = body.distances(points)
        return distances_to_each

    def near(self, center: Vector, radius: float) -> tuple[Rounded | Surface, ...]:
        """The bodies, with surfaces reduced to the elements that may be within PLANE_RANGE of a ball."""
        return tuple(
            body.near(center, radius + PLANE_RANGE) if isinstance(body, Surface) else body
            for body in self.bodies
        )

    def _to_rounded(self, points: ndarray) -> ndarray:
        local = (points @ self._turns - self._shifts).reshape(len(points), -1, 3)
        out = np.maximum(np.abs(local) - self._half, 0.0)
        # the disc is perpendicular to the z axis, so its radius is subtracted from the distance across the
        # axis
        across = np.maximum(np.hypot(out[..., 0], out[..., 1]) - self._disc, 0.0)
        return np.hypot(across, out[..., 2]) - self._rounding


def _body(shape: Shape) -> Rounded | Surface:
    zero = np.zeros(3)
    eye = np.eye(3)
    match shape:
        case Sphere():
            return Rounded(shape.center, eye, zero, 0.0, shape.radius)
        case Box():
            return Rounded(shape.center, rotation_from_quaternion(shape.wxyz), shape.size / 2, 0.0, 0.0)
        case Cylinder() | Capsule():
            half = np.array([0.0, 0.0, shape.height / 2])
            R = rotation_from_quaternion(shape.wxyz)
            disc, rounding = (0.0, shape.radius) if isinstance(shape, Capsule) else (shape.radius, 0.0)
            return Rounded(shape.center, R, half, disc, rounding)
        case PointCloud():
            return Surface(shape.points[:, None], shape.point_radius)
        case Triangulated():
            mesh = shape.mesh
            vertices = mesh.vertices @ rotation_from_quaternion(mesh.wxyz).T + mesh.xyz
            return Surface(vertices[mesh.faces], 0.0)
        case _:
            raise InputError(
                f"{shape.name}: a {type(shape).__name__} cannot be certified; it must be a sphere, box, "
                "cylinder, capsule, point cloud, mesh or height map"
            )


def _to_triangles(p: Points, triangles: Float[ndarray, "n 3 3"]) -> Values:
    """Distance of each point to its triangle: to the triangle's plane if the foot point is inside, otherwise
    to the nearest edge."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    normal_length = np.linalg.norm(normal, axis=1)
    within = normal_length > 0
    distance = np.full(len(p), np.inf)
    for start, stop in ((a, b), (b, c), (c, a)):
        edge = stop - start
        out = p - start
        within &= (np.cross(edge, out) * normal).sum(axis=1) >= 0
        length2 = np.maximum((edge**2).sum(axis=1), 1e-300)
        share = np.clip((edge * out).sum(axis=1) / length2, 0.0, 1.0)
        distance = np.minimum(distance, np.linalg.norm(out - share[:, None] * edge, axis=1))
    height = np.abs(((p - a) * normal).sum(axis=1)) / np.where(normal_length > 0, normal_length, 1.0)
    return np.where(within, np.minimum(height, distance), distance)


SCENE = "scene"
"""Name of the scene in `Claim.against`, so no link may have this name."""


class Claim(NamedTuple):
    """What must be proved for the whole motion: that a link is free of the scene, of a moving obstacle or of
    another link."""

    link: str
    against: str
    """SCENE, the name of a moving obstacle, or the name of the other link. Of two links, `link` is the one
    that is moved by at least as many joints."""


class Stretches(NamedTuple):
    """Stretches (intervals) of a motion, each for one claim. A place on the motion is the index of a row plus
    the fraction of the way to the next row."""

    claim: Int[ndarray, "n"]
    """Index of the claim."""
    start: Values
    """Place where the stretch begins."""
    stop: Values
    """Place where the stretch ends."""

    def some(self, rows: ndarray) -> "Stretches":
        """A selection of the stretches, by indices or a mask."""
        return Stretches(self.claim[rows], self.start[rows], self.stop[rows])


class Plane(NamedTuple):
    """The normal of a plane that separates a part of a link from another body, in the middle of a stretch."""

    stretch: int
    """Index of the stretch."""
    part: int
    """Index of the link's convex mesh, or of its sphere if it has no mesh."""
    other: int
    """Index of the scene's obstacle, or of the other link's part."""
    normal: tuple[float, float, float]
    """Unit normal in the base frame, which points towards the link."""


class Part(NamedTuple):
    """A convex part of a link: the convex hull of vertices, inflated by a radius."""

    vertices: Points
    faces: Int[ndarray, "f 3"]
    """Faces of the hull; empty for a single vertex."""
    rounding: float
    """Radius of the inflation [m]."""
    center: Vector
    """Center of a ball that contains the part."""
    radius: float
    """Radius of this ball [m]."""

    def reach(self, n: Points) -> Values:
        """The support function: the maximum of n · x over the part's points x, for each unit vector n."""
        return (self.vertices @ n.T).max(axis=0) + self.rounding


class Bounds(NamedTuple):
    """Bounds of clearance and displacement for each of several stretches; see the docstring of the module."""

    clearance: Values
    """Lower bound of the clearance in the middle of the stretch [m], at most CLEARANCE_CAP."""
    displacement: Values
    """Upper bound of how much of the clearance is lost anywhere on the stretch, by motions of the link and of
    the other body [m]."""


Body = Rounded | Surface | Part
Normals = dict[tuple[int, int], list[tuple[float, float, float]]]
"""Normals of planes, by the part and the other body of their `Plane`."""


class Prover:
    """Computes bounds for a robot in a scene, for a motion along straight lines through configurations, which
    may leave the lines by a known distance."""

    def __init__(
        self,
        robot: Robot,
        scene: Scene,
        q: Configurations,
        off: JointRows,
    ) -> None:
        """off: how far each joint may leave the straight line from each configuration to the next [rad] or
        [m]."""
        self.robot = robot
        self.q = q
        self.off = off
        self.linkage, self.obstacles = Linkage(robot), Obstacles(scene)
        links = self.linkage.links
        self.parts = {link: parts for link in links if (parts := _parts(robot, link))}
        if SCENE in self.parts:
            raise InputError(
                f"the robot has a link called {SCENE!r}; rename it: certificates use this name for the scene"
            )
        self._link_index = {link: k for k, link in enumerate(links)}
        self._moved = self.linkage.moved
        self.may_touch = np.array(
            [[scene.may_touch(link, name) for name in self.obstacles.names] for link in links], bool
        ).reshape(len(links), len(self.obstacles.names))
        """[links, obstacles]: whether contact is allowed; such pairs are not checked."""
        balls = [_balls(robot, link) for link in links]
        self._balls = np.concatenate([NO_SPHERES, *balls])
        self._first = np.cumsum([0, *map(len, balls)])

    def _links_of(self, claim: Claim) -> tuple[int, int]:
        """Indices of the two links of a claim; the base, which no joint moves, stands for the scene."""
        return self._link_index[claim.link], self._link_index.get(claim.against, 0)

    @cached_property
    def claims(self) -> tuple[Claim, ...]:
        """All claims: each moving link against the scene, and each pair of links that move relative to each
        other and may not touch."""
        moved = {link: self._moved[self._link_index[link]] for link in self.parts}
        level = {link: int(joints.sum()) for link, joints in moved.items()}
        moving = [Claim(link, SCENE) for link in self.parts if level[link] > 0]
        pairs = []
        for a, b in combinations(self.parts, 2):
            if (moved[a] != moved[b]).any() and frozenset((a, b)) not in self.robot.allowed_collisions:
                pairs.append(Claim(a, b) if level[a] > level[b] else Claim(b, a))
        return (*moving, *pairs)

    def at(self, places: Values) -> Configurations:
        """Configurations at places."""
        low = np.clip(places.astype(int), 0, max(len(self.q) - 2, 0))
        high = np.minimum(low + 1, len(self.q) - 1)
        share = (places - low)[:, None]
        return (1 - share) * self.q[low] + share * self.q[high]

    def spans(self, start: ndarray, stop: ndarray) -> JointRows:
        """For each stretch and joint, the largest distance from its position in the middle to its position
        anywhere on the stretch [rad] or [m]."""
        q = self.at((start + stop) / 2)
        spans = np.maximum(np.abs(self.at(start) - q), np.abs(self.at(stop) - q))
        first = np.floor(start).astype(int) + 1
        last = np.ceil(stop).astype(int) - 1
        within = np.flatnonzero(first <= last)
        if len(within):
            edges = np.column_stack([first[within], last[within] + 1]).ravel()
            rows = np.concatenate([self.q, self.q[-1:]])
            upper = np.maximum.reduceat(rows, edges)[::2]
            lower = np.minimum.reduceat(rows, edges)[::2]
            beyond = np.maximum(upper - q[within], q[within] - lower)
            spans[within] = np.maximum(spans[within], beyond)
        return spans + self.deviations(start, stop)

    def deviations(self, start: ndarray, stop: ndarray) -> JointRows:
        """How far each joint may leave the straight lines on each stretch [rad] or [m]."""
        if not len(self.off):
            return np.zeros((len(start), self.q.shape[1]))
        first = np.minimum(np.floor(start).astype(int), len(self.off) - 1)
        edges = np.column_stack([first, np.maximum(np.ceil(stop).astype(int), first + 1)]).ravel()
        return np.maximum.reduceat(np.concatenate([self.off, 0 * self.off[:1]]), edges)[::2]

    def bounds(self, stretches: Stretches, by_planes: ndarray, planes: list[Plane]) -> Bounds:
        """Bounds of stretches: by `planes` where `by_planes` is true, otherwise by the covering spheres."""
        ends, row = np.unique(np.column_stack([stretches.start, stretches.stop]), axis=0, return_inverse=True)
        row = row.ravel()
        start, stop = ends.T
        postures = self.linkage.place(self.at((start + stop) / 2))
        clearance, displacement = self._by_spheres(stretches.claim, row, postures, self.spans(start, stop))
        off = self.deviations(start, stop)
        normals = defaultdict[int, Normals](lambda: defaultdict(list))
        for plane in planes:
            normals[plane.stretch][plane.part, plane.other].append(plane.normal)
        for i in np.flatnonzero(by_planes).tolist():
            k = row[i]
            clearance[i], displacement[i] = self._by_planes(
                self.claims[stretches.claim[i]],
                Postures(*(array[k] for array in postures)),
                _steps(self, start[k], stop[k]),
                off[k],
                normals[i],
                displacement[i],
            )
        return Bounds(clearance, displacement)

    def _expand(self, links: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """All balls of the given links. Returns for each ball its row in `links` and its index, and for each
        row the position of its first ball in these arrays."""
        counts = self._first[links + 1] - self._first[links]
        begin = np.cumsum(counts) - counts
        row = np.repeat(np.arange(len(links)), counts)
        ball = np.arange(counts.sum()) - begin[row] + self._first[links][row]
        return row, ball, begin

    def _ball_bounds(
        self,
        links: ndarray,
        moved: ndarray,
        posture: ndarray,
        postures: Postures,
        spans: ndarray,
        distances: Callable[[ndarray, ndarray, ndarray], ndarray] | None = None,
    ) -> tuple[ndarray, ndarray]:
        """For each link, the clearance of its balls and an upper bound on their displacement [m].

        links: indices of links. moved: for each link, the joints that count. posture: for each link, the row
        in `postures` and `spans`. distances: computes the distance of each ball's center to the other body,
        from the ball's row in `links`, its posture and its center; None: clearances are not computed.
        """
        row, ball, begin = self._expand(links)
        at = posture[row]
        radius = self._balls[ball, 3]
        centers = placed_each(postures.T[at, links[row]], self._balls[ball, :3])
        went = self.linkage.displacement(postures, at, centers, radius, moved[row], spans)
        clearance = np.full(len(links), CLEARANCE_CAP)
        if distances is not None:
            gaps = distances(row, at, centers) - radius
            clearance = np.minimum(np.minimum.reduceat(gaps, begin), CLEARANCE_CAP)
        return clearance, np.maximum.reduceat(went, begin)

    def _by_spheres(
        self, claim: ndarray, posture: ndarray, postures: Postures, spans: ndarray
    ) -> tuple[ndarray, ndarray]:
        """Clearances and displacements by the covering spheres."""
        links, partners = np.array([self._links_of(c) for c in self.claims], int).reshape(-1, 2)[claim].T
        moved = self._moved[links]
        moves_other_only = self._moved[partners] & ~moved
        other_displacement = np.zeros(len(claim))
        some = np.flatnonzero(moves_other_only.any(axis=1))
        if len(some):
            other_displacement[some] = self._ball_bounds(
                partners[some], moves_other_only[some], posture[some], postures, spans
            )[1]
        against_scene = np.array([c.against == SCENE for c in self.claims], bool)[claim]

        def distances(row: ndarray, at: ndarray, centers: ndarray) -> Values:
            to_other = np.empty(len(row))
            scene = against_scene[row]
            gaps = self.obstacles.distances(centers[scene])
            gaps[self.may_touch[links[row[scene]]]] = CLEARANCE_CAP
            to_other[scene] = gaps.min(axis=1, initial=CLEARANCE_CAP)
            to_other[~scene] = self._to_links(postures, at[~scene], centers[~scene], partners[row[~scene]])
            return to_other

        moved_alone = moved & ~self._moved[partners]
        clearance, displacement = self._ball_bounds(links, moved_alone, posture, postures, spans, distances)
        return clearance, displacement + other_displacement

    def _to_links(self, postures: Postures, at: ndarray, centers: ndarray, link: ndarray) -> ndarray:
        """The distance of each point to the spheres of the link that it is checked against [m]. at: the
        posture; link: the index of that link."""
        distances = np.empty(len(at))
        step = MAX_ARRAY_SIZE // 64
        for first in range(0, len(at), step):
            some = slice(first, first + step)
            row, ball, begin = self._expand(link[some])
            other_centers = placed_each(postures.T[at[some][row], link[some][row]], self._balls[ball, :3])
            gaps = np.linalg.norm(centers[some][row] - other_centers, axis=1) - self._balls[ball, 3]
            distances[some] = np.minimum.reduceat(gaps, begin)
        return distances

    def _by_planes(
        self,
        claim: Claim,
        posture: Postures,
        steps: JointRows,
        off: JointValues,
        normals: Normals,
        displacement: float,
    ) -> tuple[float, float]:
        """Clearance and displacement of a stretch by planes.

        Pairs of a part of the link and an obstacle (or a part of the other link) are bounded one by one. The
        clearance of a pair is the greater of two gaps: the one between the ball around the part and the
        obstacle (or the other part's ball), and the widest one that a plane shows. The margin of a pair is a
        lower bound of its gap anywhere on the stretch: the greater of the balls' gap minus `displacement`,
        and the gap that the best plane shows all along the stretch. Returned are the smallest clearance and,
        as displacement, this clearance minus the smallest margin.

        posture: in the middle of the stretch. steps, off: the `_steps` of the joints and their `deviations`.
        displacement: by the covering spheres.
        """
        link, against = self._links_of(claim)
        # joints that move only the link, and joints that move only the other link
        mine = np.flatnonzero(self._moved[link] & ~self._moved[against])
        theirs = np.flatnonzero(self._moved[against] & ~self._moved[link])
        axes = posture.origins, posture.axes
        clearance = margin = CLEARANCE_CAP
        for p, (part, bodies, ball_gaps) in enumerate(self.pairs(claim, posture.T)):
            margins = ball_gaps - displacement
            for o, body in enumerate(bodies):
                if (p, o) not in normals:
                    continue
                n = np.array(normals[p, o])
                n /= np.linalg.norm(n, axis=1, keepdims=True)
                approach = self.linkage.approach(*axes, part.vertices, mine, steps, n, off)
                other_rise = np.zeros(len(n))
                if isinstance(body, Part):
                    other_approach = self.linkage.approach(*axes, body.vertices, theirs, steps, -n, off)
                    heights = n @ body.vertices.T
                    other_rise = (heights + other_approach).max(axis=1) - heights.max(axis=1)
                widest = gaps(part, body, n).max(axis=-1)
                remaining = (gaps(part, body, n, approach) - other_rise).max(axis=-1)
                element_gaps = np.maximum(ball_gaps[o], widest)
                element_margins = np.maximum(margins[o], remaining)
                beyond = PLANE_RANGE if isinstance(body, Surface) else CLEARANCE_CAP
                ball_gaps[o] = max(ball_gaps[o], element_gaps.min(initial=beyond))
                margins[o] = max(margins[o], element_margins.min(initial=beyond - displacement))
            clearance = ball_gaps.min(initial=clearance)
            margin = margins.min(initial=margin)
        return clearance, clearance - margin

    def pairs(self, claim: Claim, T: Poses) -> Iterator[tuple[Part, Sequence[Body], Values]]:
        """Each part of a claim's link, with the bodies that it is checked against and its distances from
        them: of the ball around the part to each obstacle, or to the balls around the parts of the other link
        [m].

        T: poses of all links. Surfaces are reduced to their near elements.
        """
        link, against = self._links_of(claim)
        bodies = placed(self.parts.get(claim.against, ()), T[against])
        for part in placed(self.parts[claim.link], T[link]):
            if claim.against == SCENE:
                distances = self.obstacles.distances(part.center[None])[0] - part.radius
                distances[self.may_touch[link]] = CLEARANCE_CAP
                yield part, self.obstacles.near(part.center, part.radius), distances
            else:
                between = part.center - np.array([body.center for body in bodies])
                radii = np.array([body.radius for body in bodies])
                yield part, bodies, np.linalg.norm(between, axis=1) - part.radius - radii


def _steps(prover: Prover, start: float, stop: float) -> JointRows:
    """Differences of configurations from that in the middle of a stretch: of its start, its stop and the rows
    between them."""
    waypoints_between = np.arange(int(np.floor(start)) + 1, int(np.ceil(stop)))
    ends = prover.at(np.array([start, (start + stop) / 2, stop]))
    return np.concatenate([ends[[0, 2]], prover.q[waypoints_between]]) - ends[1]


def gaps(
    part: Part,
    body: Body,
    normals: Float[ndarray, "k 3"],
    approach: Float[ndarray, "k v"] | None = None,
) -> Float[ndarray, "*elements k"]:
    """Widths of the gaps that planes with these unit normals show between a part and a body [m].

    For a surface, one width per element. approach: upper bound of how far each vertex of the part may move
    against each normal [m]; None: it does not move.
    """
    heights = normals @ part.vertices.T
    nearest = (heights if approach is None else heights - approach).min(axis=1) - part.rounding
    return nearest - body.reach(normals)


def placed(parts: tuple[Part, ...], T: Pose) -> list[Part]:
    """Parts of a link in the base frame. T: T_base_link."""
    R = T[:3, :3]
    t = T[:3, 3]
    return [part._replace(vertices=part.vertices @ R.T + t, center=R @ part.center + t) for part in parts]


def _balls(robot: Robot, link: str) -> Spheres:
    """The spheres that cover a link; if it has no spheres, one sphere around its meshes."""
    spheres = robot.spheres.get(link, NO_SPHERES)
    meshes = robot.meshes.get(link)
    if len(spheres) or not meshes:
        return spheres
    center, radius = ball_around(np.concatenate([mesh.vertices for mesh in meshes]))
    return np.array([[*center, radius]])


def _parts(robot: Robot, link: str) -> tuple[Part, ...]:
    """The convex meshes of a link; its spheres if it has no meshes."""
    meshes = robot.meshes.get(link)
    if meshes:
        return tuple(Part(mesh.vertices, mesh.faces, 0.0, *ball_around(mesh.vertices)) for mesh in meshes)
    none = np.zeros((0, 3), int)
    spheres = robot.spheres.get(link, ())
    return tuple(Part(s[None, :3], none, float(s[3]), s[:3], float(s[3])) for s in spheres)


class MovingProver(Prover):
    """Computes bounds for a robot among moving obstacles, for a motion that is at given configurations at
    given times, and between them on straight lines or within a known distance of these.

    The clearance of a stretch is that of the link's spheres at its middle, with the obstacle where it is at
    that time. The displacement is the sum of the displacements of the link and of the obstacle from the
    middle to anywhere on the stretch. An obstacle with unknown motion is placed where it is at time 0, and
    its displacement counts from then.
    """

    def __init__(
        self,
        robot: Robot,
        moving: Sequence[MovingObstacle],
        q: Configurations,
        times: Values,
        off: JointRows,
    ) -> None:
        super().__init__(robot, Scene(), q, off)
        self.times, self.moving = times, tuple(moving)
        self.obstacles = Obstacles(Scene([obstacle.shape for obstacle in moving]))

    @cached_property
    def claims(self) -> tuple[Claim, ...]:
        """Each moving link against each obstacle."""
        links = [link for link in self.parts if self._moved[self._link_index[link]].any()]
        return tuple(Claim(link, obstacle.name) for link in links for obstacle in self.moving)

    def bounds(self, stretches: Stretches, by_planes: ndarray, planes: list[Plane]) -> Bounds:
        """Bounds of stretches by the spheres; planes are not used."""
        middle = (stretches.start + stretches.stop) / 2
        spans = self.spans(stretches.start, stretches.stop)
        postures = self.linkage.place(self.at(middle))
        rows = np.arange(len(self.times))
        begin, at, end = (np.interp(s, rows, self.times) for s in (stretches.start, middle, stretches.stop))
        links = np.array([self._link_index[claim.link] for claim in self.claims])[stretches.claim]
        numbers = [self.obstacles.names.index(claim.against) for claim in self.claims]
        obstacle_indices = np.array(numbers)[stretches.claim]
        speed, motion_known, reference_pose = (
            np.array(values)[obstacle_indices]
            for values in zip(
                *(
                    (moving_obstacle.top_speed, moving_obstacle.known, moving_obstacle.track[1][0])
                    for moving_obstacle in self.moving
                ),
                strict=True,
            )
        )
        obstacle_motion = speed * np.where(
            motion_known, np.maximum(at - begin, end - at), np.maximum(end, 0.0)
        )
        T = np.array([self.moving[i].pose(time) for i, time in zip(obstacle_indices, at, strict=True)])

        def distances(row: ndarray, _: ndarray, centers: ndarray) -> Values:
            local = np.einsum("nji,nj->ni", T[row, :3, :3], centers - T[row, :3, 3])
            obstacle_distances = self.obstacles.distances(placed_each(reference_pose[row], local))
            return obstacle_distances[np.arange(len(row)), obstacle_indices[row]]

        posture = np.arange(len(obstacle_indices))
        moved = self._moved[links]
        clearance, arm_motion = self._ball_bounds(links, moved, posture, postures, spans, distances)
        return Bounds(clearance, arm_motion + obstacle_motion)
