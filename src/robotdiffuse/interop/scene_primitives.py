"""What programs that show scenes are given: obstacles and links as primitives, each in its frame."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.transforms import transform
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.visual_meshes import load_visual
from robotdiffuse.scenes.shapes import Box, Cylinder, PointCloud, Shape, Sphere, Triangulated

Color = tuple[int, int, int]
OBSTACLE: Color = (0xD9, 0x7B, 0x5C)


class Brick(NamedTuple):
    T: Float[ndarray, "4 4"]
    """In the frame that it is given in, as of all of them."""
    size: Float[ndarray, "3"]
    color: Color


class Ball(NamedTuple):
    T: Float[ndarray, "4 4"]
    radius: float
    color: Color


class Can(NamedTuple):
    T: Float[ndarray, "4 4"]
    radius: float
    height: float
    color: Color


class Triangles(NamedTuple):
    T: Float[ndarray, "4 4"]
    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]
    color: Color


class Points(NamedTuple):
    points: Float[ndarray, "n 3"]
    radius: float
    color: Color


Drawn = Brick | Ball | Can | Triangles | Points


def obstacles(problem: Problem) -> Iterator[tuple[str, str, Drawn]]:
    """Each obstacle's name, the frame that it is in, and what it is drawn as."""
    for shape in problem.scene.shapes:
        yield shape.name, problem.robot.base, _drawn(shape)


def _drawn(shape: Shape) -> Drawn:
    match shape:
        case Sphere():
            return Ball(transform(shape.center), shape.radius, OBSTACLE)
        case Box():
            return Brick(shape.T_base_shape, shape.size, OBSTACLE)
        case Cylinder():
            return Can(shape.T_base_shape, shape.radius, shape.height, OBSTACLE)
        case PointCloud():
            return Points(shape.points, shape.point_radius, OBSTACLE)
        case Triangulated():
            return Triangles(np.eye(4), shape.mesh.world_vertices, shape.mesh.faces, OBSTACLE)
        case _:
            T, [mesh] = shape.solid()
            return Triangles(T, mesh.vertices, mesh.faces, OBSTACLE)


def arm(robot: Robot) -> Iterator[tuple[str, str, Drawn]]:
    """The same of the meshes of links, by colour, each in the frame of its link."""
    for link, meshes in load_visual(robot).items():
        for k, mesh in enumerate(meshes):
            for color in np.unique(mesh.colors, axis=0):
                faces = mesh.faces[(mesh.colors == color).all(axis=1)]
                used, faces = np.unique(faces, return_inverse=True)
                r, g, b = color.tolist()
                name = f"{link}/{k}/{r:02x}{g:02x}{b:02x}"
                yield name, link, Triangles(np.eye(4), mesh.vertices[used], faces.reshape(-1, 3), (r, g, b))
