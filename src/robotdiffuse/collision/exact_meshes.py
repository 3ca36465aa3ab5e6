"""Exact collision of the robot's convex meshes with the scene, by Coal: the geometry of the validator.

Covering spheres play no part here, so that they can be tested against it. A link with spheres but without
meshes is taken as its spheres. Distances are signed [m]: negative inside, by penetration depth.
"""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import coal
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.collision.convex_geometry import (
    Check,
    Part,
    Solid,
    checks_of,
    describe_contact,
    parts_of,
    solids_of,
)
from robotdiffuse.collision.kernels import mesh_bounds as kernel
from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.core.deadline import check_time
from robotdiffuse.core.transforms import transform
from robotdiffuse.robots.coal_geometry import coal_convex, coal_pose, coal_surface
from robotdiffuse.robots.robot import Robot, once_per_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere, Triangulated

CHUNK = 8192
"""Configurations that `collides` treats at once; bounds its memory."""
BEYOND = 1e-6
"""A positive distance [m]: `collides` need not know any that is larger."""
MOST_CONTACTS = 200
"""Triangles or points of one obstacle that the depth of a link is looked for at; 1,000 take 5 ms."""


class Distance(NamedTuple):
    """Signed distance [m] of a link to an obstacle or another link (`other`; None if there is none)."""

    link: str
    other: str | None
    distance: float


class _Piece(NamedTuple):
    """A convex part of a link as Coal has it."""

    geometry: coal.CollisionGeometry
    frame: int
    T_frame_piece: Float[ndarray, "4 4"] | None
    """None: the geometry is in frame coordinates already."""


TREE_SECONDS = 4e-6
"""That a point or a triangle takes in Coal's tree, about [s]."""


class _Obstacle(NamedTuple):
    """A scene shape as Coal has it."""

    name: str
    geometry: coal.CollisionGeometry
    T: coal.Transform3s
    surface: bool
    """A triangle mesh or points rather than a solid."""
    inflation: float
    """The radius of each point of a point cloud [m]."""


def forward_frames(robot: Robot, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n frames 4 4"]:
    """T_base_frame of frames 0 to dof, in float64 and independent of the PyTorch kinematics."""
    slides = np.array(robot.prismatic, np.bool_)
    return kernel.forward(for_kernels(robot.frame_offsets), robot.kernel_parents, slides, for_kernels(q))


def _piece(part: Part) -> _Piece:
    if len(part.faces):
        return _Piece(coal_convex(part.vertices, part.faces), part.frame, None)
    return _Piece(coal.Sphere(part.rounding), part.frame, transform(part.center))


@once_per_robot
def _pieces(robot: Robot) -> dict[str, tuple[_Piece, ...]]:
    return {link: tuple(map(_piece, parts)) for link, parts in parts_of(robot).items()}


@once_per_robot
def _balls(robot: Robot) -> dict[str, tuple[int, ndarray, ndarray]]:
    """Of the parts of each link: its frame, and the centres [k, 3] and radii [k] of balls around them."""
    return {
        link: (parts[0].frame, np.stack([p.center for p in parts]), np.array([p.radius for p in parts]))
        for link, parts in parts_of(robot).items()
    }


def _obstacle(solid: Solid) -> _Obstacle:
    """The Coal object of a shape."""
    shape = solid.shape
    match shape:
        case Sphere():
            geometry = coal.Sphere(shape.radius)
        case Box():
            geometry = coal.Box(*shape.size)
        case Cylinder():
            geometry = coal.Cylinder(shape.radius, shape.height)
        case Capsule():
            geometry = coal.Capsule(shape.radius, shape.height)
        case Triangulated():
            geometry = coal_surface(shape.mesh.world_vertices, shape.mesh.faces)
        case PointCloud():
            # Each point is a triangle of zero size: Coal's tree then prunes 100,000 points in about 0.1 ms.
            geometry = coal_surface(shape.points, np.repeat(np.arange(len(shape.points))[:, None], 3, axis=1))
        case _:
            raise TypeError(f"no collision geometry for a {type(shape).__name__}")
    # surfaces are given in the base frame
    T = coal.Transform3s.Identity() if solid.bounds else coal_pose(solid.T_base_box)
    inflation = solid.rounding if solid.bounds else 0.0
    return _Obstacle(shape.name, geometry, T, solid.bounds, inflation)


@lru_cache(maxsize=16)
def _obstacles(scene: Scene) -> tuple[_Obstacle, ...]:
    """Kept for a few scenes: the tree over 100,000 points takes half a second."""
    obstacles: list[_Obstacle] = []
    for solid in solids_of(scene):
        count, what = _surfaces(solid.shape)
        if count:
            check_time(
                f"the validator's tree over the {count:,} {what} of {solid.shape.name}", TREE_SECONDS * count
            )
        obstacles.append(_obstacle(solid))
    return tuple(obstacles)


def _surfaces(shape: Shape) -> tuple[int, str]:
    """How many surfaces Coal sorts into a tree, and what they are."""
    if isinstance(shape, PointCloud):
        return len(shape.points), "points"
    return (len(shape.mesh.faces), "triangles") if isinstance(shape, Triangulated) else (0, "")


@dataclass(frozen=True)
class _Candidates:
    """What a check consists of: pairs of a piece with an obstacle, or of two pieces."""

    firsts: tuple[_Piece, ...]
    seconds: tuple[_Piece | _Obstacle, ...]
    lower: Callable[[ndarray], ndarray]
    """Lower bounds [n, firsts * seconds] of the signed distances, from frames [n, dof + 1, 4, 4]."""

    def pair(self, index: int) -> tuple[_Piece, _Piece | _Obstacle]:
        return self.firsts[index // len(self.seconds)], self.seconds[index % len(self.seconds)]


class ExactCollision:
    """Signed distances and collision of a robot's exact meshes with a scene and with itself.

    Links that no planned joint moves are checked against moving links only. Not safe for use by several
    threads at once.
    """

    checks: tuple[Check, ...]
    """Moving links against the scene, then the pairs of links."""

    def __init__(self, robot: Robot, scene: Scene) -> None:
        self.robot, self._solids = robot, solids_of(scene)
        self._pieces, self._obstacles = _pieces(robot), _obstacles(scene)
        self.checks = checks_of(robot)
        self.links = tuple(check.link for check in self.checks if check.other is None)
        self.pairs = tuple((a, b) for a, b in self.checks if b is not None)
        self._request = coal.DistanceRequest()
        self._request.enable_signed_distance = True
        self._first_contact, self._contacts = coal.CollisionRequest(), coal.CollisionRequest()
        self._first_contact.enable_contact = self._contacts.enable_contact = True
        self._contacts.num_max_contacts = MOST_CONTACTS
        self._collide = coal.CollisionRequest()

    @cached_property
    def _boxes(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """Of the obstacles' boxes: R_box_base [o,3,3], centres [o,3], half sizes [o,3] and roundings [o]."""
        T = np.stack([solid.T_base_box for solid in self._solids])
        return (
            np.ascontiguousarray(np.swapaxes(T[:, :3, :3], 1, 2)),
            np.ascontiguousarray(T[:, :3, 3]),
            np.stack([solid.half + solid.disc * np.array([1.0, 1.0, 0.0]) for solid in self._solids]),
            np.array([solid.rounding for solid in self._solids]),
        )

    @cached_property
    def _candidates(self) -> tuple[_Candidates, ...]:
        return tuple(self._candidates_of(check) for check in self.checks)

    def _candidates_of(self, check: Check) -> _Candidates:
        firsts = self._pieces[check.link]
        balls = _balls(self.robot)[check.link]
        if check.other is not None:
            others, other_balls = self._pieces[check.other], _balls(self.robot)[check.other]
            return _Candidates(
                firsts, others, lambda frames: kernel.pair_bounds(frames, *balls, *other_balls)
            )
        if not self._obstacles:
            return _Candidates(firsts, (), lambda frames: np.zeros((len(frames), 0)))
        boxes = self._boxes
        return _Candidates(firsts, self._obstacles, lambda frames: kernel.scene_bounds(frames, *balls, boxes))

    def _place(self, piece: _Piece, frames: ndarray) -> coal.Transform3s:
        T = frames[piece.frame]
        return coal_pose(T if piece.T_frame_piece is None else T @ piece.T_frame_piece)

    def _signed(
        self, piece: _Piece, other: _Piece | _Obstacle, frames: ndarray, cutoff: float, depth: bool
    ) -> float:
        """Signed distance of two geometries; for a surface, any value of at least `cutoff` if beyond it.

        Without `depth`, one of a surface may be understated below zero, but its sign is right.
        """
        T_piece = self._place(piece, frames)
        result = coal.DistanceResult()
        if isinstance(other, _Piece):
            T_other = self._place(other, frames)
            return coal.distance(piece.geometry, T_piece, other.geometry, T_other, self._request, result)
        if not other.surface:
            return coal.distance(piece.geometry, T_piece, other.geometry, other.T, self._request, result)
        # The distance to a pierced surface is slow and stops at any one triangle, so contacts come first.
        request, hits = self._contacts if depth else self._first_contact, coal.CollisionResult()
        coal.collide(piece.geometry, T_piece, other.geometry, other.T, request, hits)
        if hits.isCollision():
            depths = [hits.getContact(i).penetration_depth for i in range(hits.numContacts())]
            return min([0.0, *depths]) - other.inflation
        if np.isfinite(cutoff):
            result.min_distance = cutoff + other.inflation
        distance = coal.distance(piece.geometry, T_piece, other.geometry, other.T, self._request, result)
        return distance - other.inflation

    def nearest(
        self,
        q: Float[ndarray, "n dof"],
        checks: Int[ndarray, "n"],
        cutoffs: Float[ndarray, "n"],
        stop: float = -np.inf,
    ) -> tuple[Float[ndarray, "n"], list[str | None]]:
        """Signed distance of one check (an index into `checks`) at each configuration, up to its cutoff.

        Distances beyond the cutoff come back as the cutoff. Rows are treated in order, and none after the
        first that is at most `stop`: those are NaN, and the depth of that one may be understated. Returns too
        the name of the nearest obstacle or link, None beyond the cutoff.
        """
        frames = forward_frames(self.robot, q)
        distances = np.full(len(q), np.nan)
        names: list[str | None] = [None] * len(q)
        for i, (check, best) in enumerate(zip(checks.tolist(), cutoffs.tolist(), strict=True)):
            candidates = self._candidates[check]
            lower = candidates.lower(frames[i : i + 1])[0]
            for candidate in lower.argsort().tolist():
                if lower[candidate] >= best or best <= stop:
                    break
                piece, other = candidates.pair(candidate)
                distance = self._signed(piece, other, frames[i], best, depth=stop == -np.inf)
                if distance < best:
                    best = distance
                    names[i] = other.name if isinstance(other, _Obstacle) else self.checks[check].other
            distances[i] = best
            if best <= stop:
                break
        return distances, names

    def link_distances(self, q: Float[ndarray, "dof"]) -> tuple[Distance, ...]:
        """Signed distance of every moving link to the nearest obstacle (infinite in an empty scene)."""
        return self._all(q, range(len(self.links)))

    def pair_distances(self, q: Float[ndarray, "dof"]) -> tuple[Distance, ...]:
        """Signed distance of every checked pair of links."""
        return self._all(q, range(len(self.links), len(self.checks)))

    def distance_seen_from(self, link: str, q: Float[ndarray, "dof"], T: Float[ndarray, "4 4"]) -> float:
        """Signed distance of a link to the nearest obstacle after the arm was moved by T, base and all [m]:
        that to obstacles which moved the other way."""
        frames = T @ forward_frames(self.robot, q[None])[0]
        others = self._obstacles
        return min(
            self._signed(piece, other, frames, np.inf, True)
            for piece in self._pieces[link]
            for other in others
        )

    def _all(self, q: ndarray, checks: range) -> tuple[Distance, ...]:
        rows = np.tile(q, (len(checks), 1))
        distances, names = self.nearest(rows, np.array(checks, dtype=np.int64), np.full(len(checks), np.inf))
        return tuple(
            Distance(self.checks[check].link, name, distance)
            for check, name, distance in zip(checks, names, distances.tolist(), strict=True)
        )

    def collides(self, q: Float[ndarray, "n dof"]) -> Bool[ndarray, "n"]:
        """Whether each configuration touches the scene or itself."""
        return np.concatenate(
            [np.zeros(0, bool), *(self._chunk(q[i : i + CHUNK]) for i in range(0, len(q), CHUNK))]
        )

    def _chunk(self, q: ndarray) -> ndarray:
        frames = forward_frames(self.robot, q)
        hit, result = np.zeros(len(q), bool), coal.CollisionResult()
        for candidates in self._candidates:
            undecided = np.flatnonzero(~hit)
            lower = candidates.lower(frames[undecided])
            rows, columns = np.nonzero(lower <= 0)
            for row, column in zip(undecided[rows].tolist(), columns.tolist(), strict=True):
                if hit[row]:
                    continue
                piece, other = candidates.pair(column)
                if isinstance(other, _Obstacle) and other.inflation > 0:
                    hit[row] = self._signed(piece, other, frames[row], BEYOND, depth=False) <= 0
                    continue
                T_other = self._place(other, frames[row]) if isinstance(other, _Piece) else other.T
                T_piece = self._place(piece, frames[row])
                result.clear()
                coal.collide(piece.geometry, T_piece, other.geometry, T_other, self._collide, result)
                hit[row] = result.isCollision()
        return hit


@once_per_robot
def make_ready(robot: Robot) -> None:
    """Make what Coal needs of a robot, and load it, so that no call with a short limit has to."""
    explain_collision(robot, Scene([Sphere([0.0, 0.0, 100.0], 1.0)]), (robot.lower + robot.upper) / 2)


def explain_collision(robot: Robot, scene: Scene, q: Float[ndarray, "dof"]) -> str | None:
    """The deepest collision at a configuration in words, e.g. 'panda_link5 is 3.2 cm inside sphere_2'.

    None if the exact meshes are free.
    """
    exact = ExactCollision(robot, scene)
    checks = (*exact.link_distances(q), *exact.pair_distances(q))
    worst = min(checks, key=lambda check: check.distance, default=None)
    if worst is None or worst.distance > 0:
        return None
    return describe_contact(worst.link, str(worst.other), -worst.distance, worst.other in robot.link_names)
