"""Small balls that cover the surface of an arm."""

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from robotdiffuse.collision.convex_geometry import Part, parts_of
from robotdiffuse.collision.exact_meshes import forward_frames
from robotdiffuse.robots.robot import Robot, once_per_robot

CELL, SAMPLE_DISTANCE = 0.005, 0.0012
"""Edge of the cells of a grid of which those on the surface are kept; largest distance of a point of the
surface from a sample of it [m]."""
BALL_RADIUS = CELL * 3**0.5 / 2 + SAMPLE_DISTANCE
"""Radius of a ball around a cell that covers the samples in it, and what is near them [m]."""


def surface_balls(robot: Robot, q: Float[ndarray, "dof"]) -> Float32[ndarray, "n 3"]:
    """The centres of balls of BALL_RADIUS that cover the surface of moving links and of what they hold, at a
    configuration, in the base frame [m]."""
    placed = [
        points @ T[:3, :3].T + T[:3, 3]
        for T, points in zip(forward_frames(robot, q[None])[0], _balls_by_frame(robot), strict=True)
    ]
    return np.concatenate(placed).astype(np.float32)


@once_per_robot
def _balls_by_frame(robot: Robot) -> list[Float[ndarray, "n 3"]]:
    """The balls' centres by frame, in its coordinates; none in that of the base."""
    parts = [part for of_link in parts_of(robot).values() for part in of_link]
    out = [np.zeros((0, 3)) for _ in range(robot.dof + 1)]
    for frame in range(1, robot.dof + 1):
        of_frame = [part for part in parts if part.frame == frame]
        if of_frame:
            cells = np.floor(np.concatenate([_samples(part) for part in of_frame]) / CELL)
            out[frame] = (np.unique(cells, axis=0) + 0.5) * CELL
    return out


def _samples(part: Part) -> Float[ndarray, "n 3"]:
    """Points within SAMPLE_DISTANCE of each point of a part's surface."""
    if not len(part.faces):
        return _sphere(part.center, part.radius)
    return np.concatenate([_triangle(part.vertices[face]) for face in part.faces])


def _triangle(corners: Float[ndarray, "3 3"]) -> Float[ndarray, "n 3"]:
    longest = max(np.linalg.norm(corners[i] - corners[i - 1]) for i in range(3))
    count = int(np.ceil(longest / (SAMPLE_DISTANCE * 3**0.5))) + 1
    i, j = np.divmod(np.arange((count + 1) ** 2), count + 1)
    weights = np.stack([i, j, count - i - j], axis=1)[i + j <= count] / count
    return weights @ corners


def _sphere(center: Float[ndarray, "3"], radius: float) -> Float[ndarray, "n 3"]:
    """Points on a sphere, on a spiral."""
    count = max(int(4 * np.pi * (radius / SAMPLE_DISTANCE) ** 2), 1)
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    around = np.sqrt(1 - z * z)
    return center + radius * np.stack([around * np.cos(angle), around * np.sin(angle), z], axis=1)
