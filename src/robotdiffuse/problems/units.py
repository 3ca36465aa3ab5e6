"""Notes on problems whose numbers look like millimeters."""

import numpy as np

from robotdiffuse.collision.kernel_arrays import reach_bound
from robotdiffuse.core.types import Configuration, Vector
from robotdiffuse.perception.depth_view import AssumedPoints, DepthView, SeenPoints
from robotdiffuse.perception.seen_points import sphere_distances
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Mesh, PointCloud, Shape

MAX_EXTENT = 10.0
"""A mesh or a cloud gets a note if the longest edge of its bounding box exceeds this [m]; a view, if half of
its depths exceed it. Other shapes get a note only if the shortest edge exceeds it: a floor is wide, but
flat."""
OFF_MIDDLE = 1.25
"""A view gets a note if both cx and cy differ from half of the image's size by more than this factor, in the
same direction."""
VIEW_STRIDE = 4
"""Only every fourth row and column of a depth image is checked."""
MIN_POINTS_IN_ARM = 10
"""Fewer points than this inside the arm count as noise."""
ADVICE = "lengths are in meters: divide millimeters by 1000"


def unit_notes(problem: Problem) -> tuple[str, ...]:
    """Notes on numbers that may be wrong: one on each obstacle that is too large, and on each view that is
    too large, too far away, or has intrinsics that may be those of an image of another size. If there is no
    such note, no view and no moving obstacle: one on all obstacles if none is in reach."""
    reach = reach_bound(problem.robot)
    obstacles = [
        shape for shape in problem.scene.shapes if not isinstance(shape, (SeenPoints, AssumedPoints))
    ]
    shapes = [shape for shape in obstacles if not isinstance(shape, PointCloud) or len(shape.points)]
    bounds = np.array([shape.bounds for shape in shapes]).reshape(-1, 2, 3)
    extents = bounds[:, 1] - bounds[:, 0]
    of_views = (_view_note(i, view, reach) for i, view in enumerate(problem.views))
    messages = tuple(filter(None, (*map(_size_note, shapes, extents), *of_views)))
    # distances of the axis-aligned boxes from the origin [m]
    distances = np.linalg.norm(np.maximum(bounds[:, 0], -bounds[:, 1]).clip(0.0), axis=1)
    if (
        not messages
        and len(distances)
        and distances.min() > reach
        and len(obstacles) == len(problem.scene.shapes)
        and not (problem.views or problem.moving)
    ):
        count = len(distances)
        subject = f"all {count} obstacles are" if count > 1 else f"the obstacle {shapes[0].name} is"
        distance_text = (
            f"beyond the arm's reach of {reach:.1f} m, at least {distances.min():.1f} m from its base"
        )
        messages = (f"check the units: {subject} {distance_text}; {ADVICE}",)
    return messages


def arm_in_cloud_note(robot: Robot, scene: Scene, q: Configuration) -> str:
    """A note on the cloud with the most points inside the arm at a configuration; "" if no cloud has many."""
    clouds = [shape for shape in scene.shapes if type(shape) is PointCloud]
    spheres = robot.placed_spheres(q).astype(np.float32)
    counts = [int((sphere_distances(cloud.points, spheres) < 0).sum()) for cloud in clouds]
    if max(counts, default=0) < MIN_POINTS_IN_ARM:
        return ""
    densest = int(np.argmax(counts))
    cloud = clouds[densest]
    return (
        f"check the cloud: {counts[densest]} of {len(cloud.points)} points of {cloud.name} are within "
        "the arm. Remove the arm's own points, or give the cloud as a view; else check its frame (the "
        f"robot's base) and its units: {ADVICE}"
    )


def _size_note(shape: Shape, extents: Vector) -> str:
    if (extents.max() if isinstance(shape, Mesh | PointCloud) else extents.min()) <= MAX_EXTENT:
        return ""
    return f"check the units: {shape.name} is {extents.max():.4g} m long; {ADVICE}"


def _view_note(i: int, view: DepthView, reach: float) -> str:
    middle = 2 * np.divide(view.intrinsics[2:], view.depth.shape[::-1])
    if view.cloud is None and (middle.max() * OFF_MIDDLE < 1 or middle.min() > OFF_MIDDLE):
        return (
            f"check the intrinsics of views[{i}]: cx and cy, {view.intrinsics[2:]}, are far from the middle"
            f" of its image of {view.depth.shape} pixels, h x w; are they for images of another size?"
        )
    depths = view.depth[::VIEW_STRIDE, ::VIEW_STRIDE]
    depths = depths[np.isfinite(depths) & (depths > 0)]
    if not len(depths):
        return ""
    nearest = depths.min()
    half = np.median(depths)
    if half <= MAX_EXTENT and nearest <= reach + np.linalg.norm(view.T_base_camera[:3, 3]):
        return ""
    depths_are = f"depths of views[{i}] begin at {nearest:.4g} m, and half of them exceed {half:.4g} m"
    return f"check the units: the {depths_are}; {ADVICE}"
