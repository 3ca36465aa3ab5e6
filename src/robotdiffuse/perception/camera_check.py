"""A camera checked against the arm that it sees: mistakes in its pose and intrinsics are named."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from robotdiffuse.core.types import Configuration
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.ray_caster import ray_cast
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

STEP_ANGLE = 0.01
"""The arm is drawn in cells of this angle [rad]."""
SAME_DEPTH = 0.03
"""Depths that differ by less than this are of the same surface [m]."""
SPHERES_AHEAD = 0.01
"""The surfaces of the arm's covering spheres are so much ahead of its own, about [m]."""
NOTHING = Scene(())
MIN_CELLS = 40
"""Fewer cells with the arm in them say nothing."""
MIN_AGREEMENT = 0.6
"""Part of the arm's cells that have the arm's depth, at least, where the camera is as stated, within cm."""
MIN_NAMED = 0.4
"""Part of them that must agree once a mistake is undone: things before the arm may hide it."""
BETTER = 1.5
"""A mistake is named if without it the agreement is this many times as high."""
MIN_THROUGH = 0.35
"""Images that see through a larger part of the arm are not from where they say."""
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""T_link_optical: x ahead, y left and z up, as ROS has bodies, to the optical frame."""
FOCAL_FACTORS = (0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0)


def agreement(view: DepthView, robot: Robot, q: Configuration) -> tuple[float, float, int]:
    """Of the cells of an image with the arm in them, the part whose depth is the arm's, the part that sees
    through it, and their number."""
    step = max(1, round(STEP_ANGLE * view.intrinsics[0]))
    cells = view.depth[step // 2 :: step, step // 2 :: step]
    fx, fy, cx, cy = view.intrinsics
    coarse = (fx / step, fy / step, (cx - step // 2) / step, (cy - step // 2) / step)
    arm = ray_cast(NOTHING, view.T_base_camera, coarse, cells.shape[::-1], robot, q).depth
    told = np.isfinite(arm) & (cells > 0)
    behind = cells[told] - arm[told] - SPHERES_AHEAD
    if not len(behind):
        return 0.0, 0.0, 0
    same = np.abs(behind) < SAME_DEPTH
    return float(same.mean()), float((behind >= SAME_DEPTH).mean()), len(behind)


def mistakes(view: DepthView) -> Iterator[tuple[str, DepthView]]:
    """Mistakes that users make, and the view without each."""
    T = view.T_base_camera
    inverse = np.linalg.inv(T)
    flipped = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = {
        "T_base_camera is the inverse, T_camera_base": inverse,
        "T_base_camera is of the camera's body (x ahead), not of its optical frame (z ahead)": T @ OPTICAL,
        "T_base_camera is turned into the optical frame twice": T @ OPTICAL.T,
        "T_base_camera has y up and z back, as OpenGL; the optical frame has y down and z ahead": T @ flipped,
        "T_base_camera is the inverse of the pose of the camera's body": inverse @ OPTICAL,
        "T_base_camera is an inverse, turned into the optical frame": np.linalg.inv(T @ OPTICAL.T),
    }
    for name, pose in poses.items():
        yield name, replace(view, T_base_camera=pose)
    fx, fy, cx, cy = view.intrinsics
    height, width = view.depth.shape
    center = (width - 1) / 2, (height - 1) / 2
    for factor in FOCAL_FACTORS:
        name = f"the intrinsics are those of an image {1 / factor:.2g} times as wide"
        for middle in ((factor * cx, factor * cy), center):
            yield name, replace(view, intrinsics=(factor * fx, factor * fy, *middle))


def camera_note(view: DepthView, robot: Robot, start: Configuration) -> str:
    """What is wrong with a view's camera, as the arm in the image shows; "" if nothing is, or it shows too
    little. The last results are cached: calls with the same views ask for them again."""
    q = start if view.configuration is None else view.configuration
    return _camera_note(view, robot, tuple(q.tolist()))


@lru_cache(maxsize=32)
def _camera_note(view: DepthView, robot: Robot, joint_values: tuple[float, ...]) -> str:
    q = np.array(joint_values)
    found, through, count = agreement(view, robot, q)
    if count >= MIN_CELLS and found >= MIN_AGREEMENT:
        return ""
    best = ""
    highest = max(MIN_NAMED, BETTER * found if count >= MIN_CELLS else 0.0)
    for name, other in mistakes(view):
        agrees, _, cells = agreement(other, robot, q)
        if cells >= MIN_CELLS and agrees > highest:
            best = name
            highest = agrees
    if best or count < MIN_CELLS or through < MIN_THROUGH:
        return best
    return (
        f"the image sees through {100 * through:.0f} % of the arm, as its model stands there: calibrate the"
        " camera, check the joint positions, or state pose_deviation"
    )
