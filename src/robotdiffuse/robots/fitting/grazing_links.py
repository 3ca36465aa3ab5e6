"""Finds grazing links, whose convex parts can overlap where the links do not, and keeps their surfaces."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from robotdiffuse.robots.bodies import Surface
from robotdiffuse.robots.fitting.false_collisions import FalseCollisions
from robotdiffuse.robots.robot import Robot


def with_grazing_links(
    robot: Robot, surfaces: Mapping[str, tuple[Surface, ...]], measured: Iterable[FalseCollisions]
) -> Robot:
    """The robot with the surfaces of all pairs of links whose parts collided falsely in any measurement."""
    grazing = frozenset(
        frozenset(pair.links) for found in measured for pair in found.pairs if pair.by_parts > 0
    )
    links = sorted({link for pair in grazing for link in pair})
    return replace(robot, surfaces={link: _joined(surfaces[link]) for link in links}, grazing=grazing)


def _joined(surfaces: Iterable[Surface]) -> Surface:
    """One surface with equal vertices merged, so that its connected components are known; coordinates as
    stored, in float32."""
    corners = np.concatenate([surface.vertices[surface.faces].reshape(-1, 3) for surface in surfaces])
    vertices, index = np.unique(corners.astype(np.float32), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return Surface(vertices.astype(np.float64), faces[distinct])
