"""What depth views add to the scene of a problem: the points that a camera saw, few enough to plan with."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_scene_for, reach_bound
from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.perception.depth_view import DepthView, SeenPoints
from robotdiffuse.perception.seen_points_kernel import (
    gather_cloud,
    gather_image,
    near_scene,
    sphere_distances,
    supported,
)
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

VOXEL = 0.015
"""Points in a cell so wide become one, their mean [m]."""
POINT_RADIUS = 0.01
"""[m]"""
BARE_RADIUS = 0.001
"""Of points that an end would touch otherwise [m]."""
ARM = 0.02
"""Points nearer than this to the arm as it stood are the arm's own [m]."""
KNOWN = 0.01
"""Points nearer than this to a known shape are its own [m]."""
AROUND = 0.3
"""Points are kept this far beyond the robot's reach [m]."""
FEW = 3
"""Points in a cell, alone among empty ones, that are not taken for a sensor's mistake."""
FARTHEST = 2.0
"""Where a camera is that is to see a cell well [m]."""
CELLS = 1 << 16
"""That there is room for at first."""


def seen_points(
    views: Sequence[DepthView], robot: Robot, start: Float[ndarray, "dof"], voxel: float = VOXEL
) -> Float32[ndarray, "n 3"]:
    """The mean of the points in each cell of a grid, in the base frame [m].

    Without flying pixels, what lies on the arm as it stood in each view, and what is far beyond its reach.
    """
    room = CELLS
    while True:
        keys = np.full(4 * room, -1, np.int64)
        cells, sums = np.zeros(4 * room, np.int32), np.zeros((room, 4), np.float32)
        count = 0
        for view in views:
            spheres = placed_spheres(robot, start if view.configuration is None else view.configuration)
            spheres = (spheres + np.array([0, 0, 0, ARM])).astype(np.float32)
            rest = (
                np.float32(reach_bound(robot) + AROUND),
                spheres,
                np.float32(voxel),
                keys,
                cells,
                sums,
                count,
            )
            if view.cloud is not None:
                count = gather_cloud(for_kernels(view.cloud), *rest)
            else:
                image = for_kernels(view.depth, np.float32)
                intrinsics = tuple(map(np.float32, view.intrinsics))
                count = gather_image(image, intrinsics, view.T_base_camera.astype(np.float32), *rest)
            if count < 0:
                break
        if count >= 0:
            kept = supported(keys, cells, sums, count, np.float32(_least(views, voxel)))
            return sums[:count, :3][kept] / sums[:count, 3:][kept]
        room *= 4


def _least(views: Sequence[DepthView], voxel: float) -> int:
    """Points that make a cell one that was seen: a few, where images are so fine that it should have many."""
    focal = min((0.0 if view.cloud is not None else view.intrinsics[0] for view in views), default=0.0)
    return FEW if (voxel * focal / FARTHEST) ** 2 >= FEW**2 else 1


def seen_shapes(
    views: Sequence[DepthView],
    robot: Robot,
    known: Scene,
    start: Float[ndarray, "dof"],
    goals: Float[ndarray, "n dof"],
) -> tuple[SeenPoints, ...]:
    """What was seen beside the known shapes, as obstacles.

    Points are spheres of POINT_RADIUS; those that the spheres of start or goals would touch then, of
    BARE_RADIUS: what is added to a point for safety must not make an end invalid that is free. What lies
    within KNOWN of a known shape is taken as a part of it.
    """
    points = seen_points(views, robot, start)
    if known.shapes:
        points = points[~near_scene(compile_scene_for(robot, known), points, np.float32(KNOWN))]
    ends = np.concatenate([placed_spheres(robot, q) for q in (start, *goals)]).astype(np.float32)
    close = sphere_distances(points, ends) < POINT_RADIUS + BARE_RADIUS
    parts = (~close, POINT_RADIUS, "seen"), (close, BARE_RADIUS, "seen_at_ends")
    return tuple(SeenPoints(points[part], radius, name=name) for part, radius, name in parts if part.any())
