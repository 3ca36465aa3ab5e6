"""A robot of three bars, and the mesh of a cube."""

import numpy as np

from helpers.box_arm import box_mesh
from robotdiffuse.core.transforms import transform
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import ConvexMesh, Robot

cube = box_mesh(-np.ones(3), np.ones(3))
CORNERS, CUBE = cube.vertices, cube.faces


def bar(length: float) -> ConvexMesh:
    """A square bar of 8 cm along z, from the origin."""
    return box_mesh(np.array([-0.04, -0.04, 0]), np.array([0.04, 0.04, length]))


def three_bars() -> Robot:
    """Three bars: a rotating pillar, a hinge whose axis is not parallel to z, and a slide."""
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    z = np.array([0.0, 0, 1])
    y = np.array([0.0, 1, 0])
    limits = (-3.0, 3.0, 2.0, 5.0, 50.0)
    joints = (
        Joint("turn", "revolute", "base", "pillar", transform(np.array([0, 0, 0.1])), z, *limits),
        Joint("hinge", "revolute", "pillar", "arm", transform(np.array([0, 0, 0.4]), quarter), y, *limits),
        Joint("slide", "prismatic", "arm", "tip", transform(np.array([0, 0, 0.3])), z, *limits),
    )
    meshes = {"base": (bar(0.1),), "pillar": (bar(0.4),), "arm": (bar(0.3),), "tip": (bar(0.2),)}
    return Robot("three_bars", "base", "tip", joints, {"tip": np.array([[0, 0, 0.1, 0.12]])}, meshes)
