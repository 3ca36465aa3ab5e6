"""Obstacles and links as primitives in their frames, for programs that display scenes."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.transforms import inverse, transform
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.visual_meshes import load_visual
from robotdiffuse.scenes.mesh import Triangulated
from robotdiffuse.scenes.shapes import Box, Cylinder, PointCloud, Shape, Sphere

Color = tuple[int, int, int]
OBSTACLE_COLOR: Color = (0xD9, 0x7B, 0x5C)


class BoxPrimitive(NamedTuple):
    T: Float[ndarray, "4 4"]
    """Pose in the frame that it is listed with."""
    size: Float[ndarray, "3"]
    color: Color


class SpherePrimitive(NamedTuple):
    T: Float[ndarray, "4 4"]
    radius: float
    color: Color


class CylinderPrimitive(NamedTuple):
    T: Float[ndarray, "4 4"]
    radius: float
    height: float
    color: Color


class MeshPrimitive(NamedTuple):
    T: Float[ndarray, "4 4"]
    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]
    color: Color


class PointsPrimitive(NamedTuple):
    points: Float[ndarray, "n 3"]
    radius: float
    color: Color


Primitive = BoxPrimitive | SpherePrimitive | CylinderPrimitive | MeshPrimitive | PointsPrimitive


def obstacles(problem: Problem) -> Iterator[tuple[str, str, Primitive]]:
    """Name, frame and primitive of each obstacle; moving ones have the frames of `moving_frames`."""
    for shape in problem.scene.shapes:
        yield shape.name, problem.robot.base, _primitive(shape)
    for moving, frame in zip(problem.moving, moving_frames(problem, 0.0), strict=True):
        yield moving.name, frame, _primitive(moving.shape.moved(inverse(moving.shape.T_base_shape)))


def moving_frames(problem: Problem, time: float) -> dict[str, Float[ndarray, "4 4"]]:
    """T_base_obstacle by the frame of each moving obstacle at a time [s]; at time 0 if its motion is
    unknown."""
    return {f"moving/{moving.name}": moving.pose(time) for moving in problem.moving}


def _primitive(shape: Shape) -> Primitive:
    match shape:
        case Sphere():
            return SpherePrimitive(transform(shape.center), shape.radius, OBSTACLE_COLOR)
        case Box():
            return BoxPrimitive(shape.T_base_shape, shape.size, OBSTACLE_COLOR)
        case Cylinder():
            return CylinderPrimitive(shape.T_base_shape, shape.radius, shape.height, OBSTACLE_COLOR)
        case PointCloud():
            return PointsPrimitive(shape.points, shape.point_radius, OBSTACLE_COLOR)
        case Triangulated():
            return MeshPrimitive(np.eye(4), shape.mesh.world_vertices, shape.mesh.faces, OBSTACLE_COLOR)
        case _:
            T, [mesh] = shape.solid()
            return MeshPrimitive(T, mesh.vertices, mesh.faces, OBSTACLE_COLOR)


def arm(robot: Robot) -> Iterator[tuple[str, str, Primitive]]:
    """Name, frame and primitive of the link meshes, one for each colour, in the frames of their links."""
    for link, meshes in load_visual(robot).items():
        for k, mesh in enumerate(meshes):
            for color in np.unique(mesh.colors, axis=0):
                faces = mesh.faces[(mesh.colors == color).all(axis=1)]
                used, faces = np.unique(faces, return_inverse=True)
                r, g, b = color.tolist()
                name = f"{link}/{k}/{r:02x}{g:02x}{b:02x}"
                yield (
                    name,
                    link,
                    MeshPrimitive(np.eye(4), mesh.vertices[used], faces.reshape(-1, 3), (r, g, b)),
                )
