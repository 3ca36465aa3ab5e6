"""The exact geometry of robots and scenes: convex parts of links, solids, and the pairs that are checked.

This geometry does not depend on the covering spheres, so the spheres can be tested against it. Only a link
without meshes is represented by its spheres.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from robotdiffuse.collision.kernels.convex_bounds import Hulls, Solids
from robotdiffuse.core.transforms import ball_around, box_around, placed, transform
from robotdiffuse.core.types import NO_SPHERES, Points, Pose, Vector
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.robots.robot import Robot, pairs_to_check
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere, Triangulated

SURFACES_BELOW = 0.002
"""Distance between the convex parts of two grazing links (see `Robot.grazing`) below which their mesh
surfaces decide whether they collide [m]."""


class Check(NamedTuple):
    """A collision check: a link against the scene (`other` is None), or two links against each other."""

    link: str
    other: str | None

    def __str__(self) -> str:
        return f"{self.link} against {self.other or 'the scene'}"


class Part(NamedTuple):
    """A convex part of a link in the frame that the link is fixed to: a convex hull, inflated by
    `rounding`."""

    frame: int
    vertices: Points
    faces: Int[ndarray, "f 3"]
    """Triangles of the hull; empty for a ball, which has one vertex."""
    rounding: float
    center: Vector
    """Center of a ball around the part."""
    radius: float


class Solid(NamedTuple):
    """A scene shape as the Minkowski sum of a box, a disc around its z axis and a ball."""

    shape: Shape
    T_base_box: Pose
    half: Vector
    """Half edge lengths of the box [m]."""
    disc: float
    """Radius of the disc [m]."""
    rounding: float
    """Radius of the ball [m]."""
    is_bound: bool
    """Whether the sum only encloses the shape, which is a surface or a point cloud."""


@once_per_robot
def parts_of(robot: Robot) -> dict[str, tuple[Part, ...]]:
    """Convex parts of every link that has geometry."""
    parts = dict[str, tuple[Part, ...]]()
    for link in robot.link_names:
        frame = robot.link_frame(link)
        T = robot.T_frame_link(link)
        convex_parts = list[Part]()
        for mesh in robot.meshes.get(link, ()):
            vertices = placed(T, mesh.vertices)
            convex_parts.append(Part(frame, vertices, mesh.faces, 0.0, *ball_around(vertices)))
        if not convex_parts:
            for x, y, z, radius in robot.spheres.get(link, NO_SPHERES).tolist():
                center = T[:3, :3] @ np.array([x, y, z]) + T[:3, 3]
                convex_parts.append(Part(frame, center[None], np.zeros((0, 3), int), radius, center, radius))
        if convex_parts:
            parts[link] = tuple(convex_parts)
    return parts


@once_per_robot
def checks_of(robot: Robot) -> tuple[Check, ...]:
    """The moving links against the scene, then the pairs of links that may not collide."""
    links = list(parts_of(robot))
    moving = (Check(link, None) for link in links if robot.link_frame(link) > 0)
    pairs = (Check(*pair) for pair in pairs_to_check(robot, links))
    return (*moving, *pairs)


@once_per_robot
def hulls_of(robot: Robot) -> tuple[Hulls, dict[str, range]]:
    """The arrays of all links' convex parts for compiled code, and the index range of each link's parts."""
    part_ranges = {}
    all_parts = list[Part]()
    for link, parts in parts_of(robot).items():
        part_ranges[link] = range(len(all_parts), len(all_parts) + len(parts))
        all_parts += parts
    vertices = np.concatenate([part.vertices for part in all_parts]) if all_parts else np.zeros((0, 3))
    hulls = Hulls(
        np.ascontiguousarray(vertices.T),
        np.cumsum([0] + [len(part.vertices) for part in all_parts]),
        np.array([part.frame for part in all_parts], np.int64),
        np.array([[*part.center, part.radius] for part in all_parts]).reshape(-1, 4),
        np.array([part.rounding for part in all_parts], np.float64),
    )
    return hulls, part_ranges


@lru_cache(maxsize=16)
def solids_of(scene: Scene) -> tuple[Solid, ...]:
    """The obstacles of a scene, without empty point clouds."""
    return tuple(solid for solid in map(_solid, scene.shapes) if solid is not None)


def allowed_contacts(scene: Scene, links: Sequence[str], solids: Sequence[Solid]) -> Bool[ndarray, "l s"]:
    """Whether each link may touch each solid; of shape [0, 0] if the scene allows no contact."""
    if not scene.allowed_contacts:
        return np.zeros((0, 0), np.bool_)
    names = [solid.shape.name for solid in solids]
    allowed = {name: [scene.may_touch(link, name) for link in links] for name in dict.fromkeys(names)}
    return np.array([allowed[name] for name in names], np.bool_).reshape(len(names), len(links)).T.copy()


def solid_arrays(robot: Robot, scene: Scene) -> Solids:
    """The arrays of the obstacles for compiled code."""
    solids = solids_of(scene)
    T = np.array([solid.T_base_box for solid in solids]).reshape(-1, 4, 4)
    return Solids(
        np.ascontiguousarray(np.swapaxes(T[:, :3, :3], 1, 2)),
        np.ascontiguousarray(T[:, :3, 3]),
        np.array([solid.half for solid in solids], np.float64).reshape(-1, 3),
        np.array([solid.disc for solid in solids], np.float64),
        np.array([solid.rounding for solid in solids], np.float64),
        np.array([solid.is_bound for solid in solids], np.bool_),
        allowed_contacts(scene, [check.link for check in checks_of(robot)], solids),
    )


def _solid(shape: Shape) -> Solid | None:
    match shape:
        case Sphere():
            return Solid(shape, transform(shape.center), np.zeros(3), 0.0, shape.radius, False)
        case Box():
            return Solid(shape, shape.T_base_shape, shape.size / 2, 0.0, 0.0, False)
        case Cylinder() | Capsule():
            half = np.array([0.0, 0.0, shape.height / 2])
            radii = (shape.radius, 0.0) if isinstance(shape, Cylinder) else (0.0, shape.radius)
            return Solid(shape, shape.T_base_shape, half, *radii, False)
        case Triangulated():
            return _bounded(shape, shape.mesh.world_vertices, 0.0)
        case PointCloud():
            return _bounded(shape, shape.points, shape.point_radius) if len(shape.points) else None
        case _:
            raise TypeError(f"no collision geometry for a {type(shape).__name__}")


def _bounded(shape: Shape, points: Points, inflation: float) -> Solid:
    low, high = box_around(points)
    return Solid(shape, transform((low + high) / 2), (high - low) / 2, 0.0, inflation, True)


def describe_contact(link: str, other: str, depth: float, itself: bool) -> str:
    """A contact of penetration `depth` [m] in words: 'panda_link5 is 3.2 cm inside sphere_2'. With `itself`,
    both bodies are links: 'a and b overlap by 3.2 cm'."""
    length = f"{depth * 100:.1f} cm" if depth >= 0.01 else f"{depth * 1000:.1f} mm"
    if depth < 5e-5:
        return f"{link} touches {other}"
    return f"{link} and {other} overlap by {length}" if itself else f"{link} is {length} inside {other}"
