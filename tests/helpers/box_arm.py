"""A planar arm of boxes with known geometry, for the tests of collision and of the validator; meshes of boxes."""

from dataclasses import replace
from functools import cache

import numpy as np
import trimesh
from numpy import ndarray
from scipy.spatial import ConvexHull

from helpers.example_robots import planar_arm
from robotdiffuse.robots.bodies import Surface
from robotdiffuse.robots.robot import ConvexMesh, Robot

HALF_WIDTH = 0.03


def box_mesh(low: ndarray, high: ndarray) -> ConvexMesh:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
    hull = ConvexHull(corners)
    outward = np.linalg.det(np.stack([corners[f] - corners.mean(0) for f in hull.simplices])) > 0
    return ConvexMesh(corners, np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1]).astype(np.int64))


@cache
def box_arm(spheres: bool = True) -> Robot:
    """Three boxes of 0.5, 0.4 and 0.3 m that turn about z, 6 cm wide and high; the first and the third may collide."""
    lengths = (0.5, 0.4, 0.3)
    robot = planar_arm(*lengths)
    meshes = {}
    covers = {}
    w = HALF_WIDTH
    limits = {"lower": -2.8, "upper": 2.8, "velocity": 2.0, "acceleration": 8.0, "jerk": 80.0}
    for i, length in enumerate(lengths, 1):
        low = np.array([0.0, -w, -w])
        high = np.array([length, w, w])
        cells = int(length / 0.05)
        xs = (np.arange(cells) + 0.5) * length / cells
        radius = float(np.linalg.norm([length / cells / 2, w, w]))
        meshes[f"l{i}"] = (box_mesh(low, high),)
        covers[f"l{i}"] = np.column_stack([xs, np.zeros((cells, 2)), np.full(cells, radius)])
    return replace(
        robot,
        joints=(*(replace(joint, **limits) for joint in robot.joints[:-1]), robot.joints[-1]),
        meshes=meshes,
        spheres=covers if spheres else {},
        allowed_collisions=frozenset({frozenset(("l1", "l2")), frozenset(("l2", "l3"))}),
    )


def surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.array(mesh.vertices), np.array(mesh.faces))


def boxes(*ends: tuple[tuple[float, ...], tuple[float, ...]]) -> trimesh.Trimesh:
    """Closed boxes from their lowest to their highest corners; where they meet, there are inner walls."""
    made = trimesh.util.concatenate([trimesh.creation.box(bounds=np.array(each)) for each in ends])
    assert isinstance(made, trimesh.Trimesh)
    return made
