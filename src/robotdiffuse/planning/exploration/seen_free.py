"""Obstacles that keep an arm within space that was seen free."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import reach_ball
from robotdiffuse.collision.motions import with_covering_spheres
from robotdiffuse.perception.depth_view import AssumedPoints
from robotdiffuse.perception.occupancy_map import OccupancyMap
from robotdiffuse.perception.unknown_space import CARVING_MARGIN, without_known
from robotdiffuse.perception.voxel_grid import MAP, surface
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Shape

COVER_RADIUS = MAP.edge * 3**0.5 / 2
"""Radius of the ball around a voxel's centre that covers the voxel [m]."""
MIN_FREE_SHARE = 0.8
"""Searches fail where a smaller part of what the arm fills at the goal, and not at the start, was seen free:
see benchmarks/results/exploring.txt."""
WALL = 2.0
"""Thickness of the walls around the map [m]."""


def not_seen_free(
    known: OccupancyMap, known_scene: Scene, ends: Sequence[Float[ndarray, "dof"]]
) -> tuple[Shape, ...]:
    """Obstacles that cover all space that the map does not know to be free, apart from the known scene's.

    Balls cover the voxels at the surface of that space, and walls stand around the map, so a motion that the
    validator accepts among them enters no other voxel. ends: configurations around which CARVING_MARGIN is
    taken as free; seen points are obstacles of their own.
    """
    points = surface(~known.free & ~near_ends(known, ends))
    return cover(known, known_scene, points, "not seen free"), *_walls()


def near_ends(known: OccupancyMap, ends: Sequence[Float[ndarray, "dof"]]) -> Bool[ndarray, "nx ny nz"]:
    """The voxels around the arm at these configurations that count as free."""
    return MAP.filled(known.robot, ends, CARVING_MARGIN + MAP.edge / 2)


def hardly_seen(known: OccupancyMap, start: Float[ndarray, "dof"], goal: Float[ndarray, "dof"]) -> bool:
    """Whether so little was seen free around a goal that searches within space seen free are in vain."""
    filled = near_ends(known, (goal,)) & ~near_ends(known, (start,))
    return bool(known.free[filled].sum() < MIN_FREE_SHARE * filled.sum())


def cover(known: OccupancyMap, known_scene: Scene, voxels: Int[ndarray, "n 3"], name: str) -> AssumedPoints:
    """Balls that cover the voxels of these indices, without those in the known scene and out of reach."""
    points = MAP.centers(voxels)
    center, reach = reach_ball(with_covering_spheres(known.robot))
    points = points[np.linalg.norm(points - center, axis=1) < reach + COVER_RADIUS]
    points = without_known(points, MAP.edge, known.robot, known_scene)
    return AssumedPoints(points, COVER_RADIUS, name=name)


def least_unknown(known: OccupancyMap, goals: Float[ndarray, "n dof"]) -> Float[ndarray, "dof"]:
    """The configuration at which the arm fills the fewest unknown voxels."""
    return min(goals, key=lambda q: int((known.unknown & MAP.filled(known.robot, [q])).sum()))


def reaches_outside(robot: Robot, q: Float[ndarray, "dof"]) -> bool:
    """Whether the arm reaches out of the map: centres of its covering spheres lie outside."""
    low, high = _ends_of_map()
    centers = placed_spheres(robot, q)[:, :3]
    return bool(((centers < low) | (centers > high)).any())


def _ends_of_map() -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]]:
    low = np.array(MAP.low)
    return low, low + np.array(MAP.shape) * MAP.edge


def _walls() -> list[Box]:
    """Boxes around the map."""
    low, high = _ends_of_map()
    walls = []
    for axis in range(3):
        for at, name in ((low[axis] - WALL / 2, "before"), (high[axis] + WALL / 2, "beyond")):
            center, size = (low + high) / 2, high - low + 2 * WALL
            center[axis], size[axis] = at, WALL
            walls.append(Box(tuple(center), tuple(size), name=f"{name} the map, {'xyz'[axis]}"))
    return walls
