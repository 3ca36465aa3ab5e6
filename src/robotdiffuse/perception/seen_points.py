"""Reduces depth views to few points, which are added to the scene of a problem."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_scene_for, reach_bound
from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.perception.depth_filter import filtered, grown_for_noise
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
"""Edge length of the cells whose points are replaced by their mean [m]."""
POINT_RADIUS = 0.01
"""Radius of the obstacle around each point [m]."""
MIN_POINT_RADIUS = 0.001
"""Radius of points that would otherwise collide at start or goal [m]."""
ARM_DISTANCE = 0.02
"""Points within this distance of the arm, at its configuration in the view, are points of the arm [m]; more
with noise: see `grown_for_noise`."""
KNOWN_DISTANCE = 0.01
"""Points within this distance of a known shape are points of the shape [m]."""
REACH_MARGIN = 0.3
"""Points are kept up to this distance beyond the robot's reach [m]."""
MIN_CELL_POINTS = 3
"""Minimum number of points of an isolated cell; cells with fewer are sensor errors."""
CAMERA_DISTANCE = 2.0
"""Distance at which a camera of sufficient resolution has many pixels per cell [m]."""
INITIAL_CELLS = 1 << 16
"""Initial capacity of the table of cells."""


def seen_points(
    views: Sequence[DepthView], robot: Robot, start: Float[ndarray, "dof"], voxel: float = VOXEL
) -> Float32[ndarray, "n 3"]:
    """The mean of the observed points in each cell of a grid, in the base frame [m].

    Flying pixels, points of the arm at its configuration in each view, and points far beyond its reach are
    left out.
    """
    capacity = INITIAL_CELLS
    while True:
        keys = np.full(4 * capacity, -1, np.int64)
        cells, sums = np.zeros(4 * capacity, np.int32), np.zeros((capacity, 4), np.float32)
        count = 0
        for view in views:
            spheres = placed_spheres(robot, start if view.configuration is None else view.configuration)
            depth, spread = filtered(view)
            spheres = grown_for_noise(spheres, view.T_base_camera, spread)
            spheres = (spheres + np.array([0, 0, 0, ARM_DISTANCE])).astype(np.float32)
            rest = (
                np.float32(reach_bound(robot) + REACH_MARGIN),
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
                intrinsics = tuple(map(np.float32, view.intrinsics))
                count = gather_image(depth, intrinsics, view.T_base_camera.astype(np.float32), *rest)
            if count < 0:
                break
        if count >= 0:
            kept = supported(keys, cells, sums, count, np.float32(_min_cell_points(views, voxel)))
            return sums[:count, :3][kept] / sums[:count, 3:][kept]
        capacity *= 4


def _min_cell_points(views: Sequence[DepthView], voxel: float) -> int:
    """Minimum number of points of an isolated cell: more than one only if all images have many pixels per
    cell."""
    focal = min((0.0 if view.cloud is not None else view.intrinsics[0] for view in views), default=0.0)
    return MIN_CELL_POINTS if (voxel * focal / CAMERA_DISTANCE) ** 2 >= MIN_CELL_POINTS**2 else 1


def seen_shapes(
    views: Sequence[DepthView],
    robot: Robot,
    known: Scene,
    start: Float[ndarray, "dof"],
    goals: Float[ndarray, "n dof"],
) -> tuple[SeenPoints, ...]:
    """The points that views observed as obstacles; see `point_shapes`."""
    return point_shapes(seen_points(views, robot, start), robot, known, start, goals)


def point_shapes(
    points: Float[ndarray, "points 3"],
    robot: Robot,
    known: Scene,
    start: Float[ndarray, "dof"],
    goals: Float[ndarray, "n dof"],
) -> tuple[SeenPoints, ...]:
    """Observed points as obstacles, without those of known shapes.

    Points get POINT_RADIUS, but those that the arm's spheres at start or goals would then touch get
    MIN_POINT_RADIUS: this safety margin must not make a free start or goal invalid. Points within
    KNOWN_DISTANCE of a known shape are left out.
    """
    points = points.astype(np.float32)
    if known.shapes:
        points = points[~near_scene(compile_scene_for(robot, known), points, np.float32(KNOWN_DISTANCE))]
    ends = np.concatenate([placed_spheres(robot, q) for q in (start, *goals)]).astype(np.float32)
    close = sphere_distances(points, ends) < POINT_RADIUS + MIN_POINT_RADIUS
    parts = (~close, POINT_RADIUS, "seen"), (close, MIN_POINT_RADIUS, "seen_at_ends")
    return tuple(SeenPoints(points[part], radius, name=name) for part, radius, name in parts if part.any())
