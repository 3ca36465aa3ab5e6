"""Checks a camera's pose and intrinsics against the arm in its image, and names mistakes in them."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from robotdiffuse.core.errors import shown
from robotdiffuse.core.transforms import placed, pose, quaternion_from_rotation
from robotdiffuse.core.types import Configuration
from robotdiffuse.perception.depth_view import FARTHEST, NEAREST, DepthImage, DepthView
from robotdiffuse.perception.ray_caster import ray_cast
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

STEP_ANGLE = 0.01
"""Angular width of the image cells in which measured depths and the arm's are compared [rad]."""
SAME_DEPTH = 0.03
"""Depths that differ by less than this belong to the same surface [m]."""
SPHERES_AHEAD = 0.01
"""How far the arm's covering spheres are in front of its surface, approximately [m]."""
NOTHING = Scene(())
MIN_FOCAL_FRACTION = 0.05
"""Smallest focal length, as a fraction of the image's width and height: such an image spans 169 degrees."""
MAX_INTRINSICS = 100.0
"""Largest magnitude of fx and cx, as a multiple of the image's width, and of fy and cy, of its height."""
MAX_THROUGH = 0.9
"""An image that sees through a larger fraction of the arm cannot be that of the stated camera."""
MIN_CELLS = 40
"""A view in which fewer cells show the arm neither confirms nor contradicts its camera."""
MIN_AGREEMENT = 0.6
"""If at least this fraction of the arm's cells has the arm's depth, the camera is correct to centimeters."""
MIN_NAMED = 0.4
"""A mistake is named only if, once it is undone, more than this fraction of the arm's cells have the arm's
depth. The fraction is below MIN_AGREEMENT, since objects in front of the arm may hide it."""
BETTER = 1.5
"""A mistake is named only if undoing it raises the agreement by at least this factor."""
STANDS_OUT = 0.2
"""A mistake is named only if undoing it fits the arm at one place only: each of SHIFTS, applied to the image
rendered of the arm, must lower the fraction of the arm's cells with the arm's depth by more than this. It
falls less if these depths are from a table, which has similar depths all around."""
SHIFTS = ((0, 12), (0, -12), (12, 0), (-12, 0))
"""Movements of the image rendered of the arm, down and to the right [cells]."""
MIN_THROUGH = 0.35
"""An image that sees through at least this fraction of the arm gets a note even if no mistake explains it."""
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""T_body_optical: maps the optical frame to a body's frame in ROS (x ahead, y left, z up)."""
FOCAL_FACTORS = (0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0)
"""Factors for the focal length that are tried, in case the image was resized after the calibration."""


def agreement(view: DepthView, robot: Robot, q: Configuration) -> tuple[float, float, int]:
    """Compares an image with the arm's model at a configuration; see `_compared`."""
    return _compared(*_images(view, robot, q))


def _images(view: DepthView, robot: Robot, q: Configuration) -> tuple[DepthImage, DepthImage]:
    """The depths of the image's cells, and those at which the model at a configuration shows the arm
    (infinite elsewhere) [m]."""
    step = min(max(1, round(STEP_ANGLE * view.intrinsics[0])), *view.depth.shape)
    cells = view.depth[step // 2 :: step, step // 2 :: step]
    fx, fy, cx, cy = view.intrinsics
    cell_intrinsics = (fx / step, fy / step, (cx - step // 2) / step, (cy - step // 2) / step)
    return cells, ray_cast(NOTHING, view.T_base_camera, cell_intrinsics, cells.shape[::-1], robot, q).depth


def _compared(cells: DepthImage, arm: DepthImage) -> tuple[float, float, int]:
    """For the cells in which the model shows the arm and the image has a depth: the fraction whose depth is
    the arm's, the fraction that sees through the arm (larger depths), and the number of these cells."""
    compared = np.isfinite(arm) & (cells > 0)
    excess = cells[compared] - arm[compared] - SPHERES_AHEAD
    if not len(excess):
        return 0.0, 0.0, 0
    agree = np.abs(excess) < SAME_DEPTH
    return float(agree.mean()), float((excess >= SAME_DEPTH).mean()), len(excess)


def implausible(view: DepthView) -> str:
    """A message if the units of an image or its intrinsics cannot be right for any scene; "" otherwise."""
    height, width = view.depth.shape
    relative = np.abs(view.intrinsics) / (width, height, width, height)
    if view.cloud is None and (relative[:2].min() < MIN_FOCAL_FRACTION or relative.max() > MAX_INTRINSICS):
        return f"its intrinsics, {shown(view.intrinsics)}, do not fit an image of {width} x {height} pixels"
    returns = view.depth
    if view.cloud is not None:  # the image leaves out points behind the camera
        returns = np.linalg.norm(view.cloud - view.T_base_camera[:3, 3], axis=1)
    returns = returns[np.isfinite(returns) & (returns > 0)]
    middle = np.median(returns) if len(returns) else 0.0
    if middle <= FARTHEST:
        return ""
    return f"its depths are about {middle:.4g}; they must be in meters, and 0 where nothing was measured"


def contradiction(view: DepthView, robot: Robot, q: Configuration) -> str:
    """What `camera_note` finds if the image sees through nearly all of the arm; "" otherwise. Only for
    cameras beside the arm: a camera on the arm is so near that with a small error of its pose, it may seem to
    see through the arm."""
    _, through, count = agreement(view, robot, q)
    return camera_note(view, robot, q) if count >= MIN_CELLS and through > MAX_THROUGH else ""


def mistakes(view: DepthView) -> Iterator[tuple[str, DepthView]]:
    """Yields common mistakes, each as its description and the view with the mistake undone."""
    T = view.T_base_camera
    cloud = view.cloud
    if cloud is not None and cloud[:, 2].max() > NEAREST:
        yield (
            "the cloud is in the camera's frame; it must be in the frame of the base",
            DepthView.from_cloud(placed(T, cloud), T),
        )
    inverse = np.linalg.inv(T)
    wxyz = quaternion_from_rotation(T)
    flipped = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = {
        "T_base_camera is the inverse, T_camera_base": inverse,
        "T_base_camera is of the camera's body (x ahead), not of its optical frame (z ahead)": T @ OPTICAL,
        "T_base_camera is turned into the optical frame twice": T @ OPTICAL.T,
        "T_base_camera has y up and z back, as OpenGL; the optical frame has y down and z ahead": T @ flipped,
        "T_base_camera is the inverse of the pose of the camera's body": inverse @ OPTICAL,
        "T_base_camera is T_camera_base, turned into the optical frame": np.linalg.inv(T @ OPTICAL.T),
    }
    for name, quaternion in (
        ("transposed rotation", wxyz * (1, -1, -1, -1)),
        ("quaternion x y z w that was read as w x y z", np.roll(wxyz, 1)),
        ("quaternion w x y z that was read as x y z w", np.roll(wxyz, -1)),
    ):
        poses[f"T_base_camera has a {name}"] = pose(T[:3, 3], wxyz=quaternion)
    for name, T_corrected in poses.items():
        yield name, replace(view, T_base_camera=T_corrected)
    fx, fy, cx, cy = view.intrinsics
    height, width = view.depth.shape
    center = (width - 1) / 2, (height - 1) / 2
    for factor in FOCAL_FACTORS:
        name = f"the intrinsics are those of an image {1 / factor:.2g} times as wide"
        for middle in ((factor * cx, factor * cy), center):
            yield name, replace(view, intrinsics=(factor * fx, factor * fy, *middle))


def camera_note(view: DepthView, robot: Robot, start: Configuration) -> str:
    """What is wrong with a view's camera, as the arm in the image shows; "" if nothing wrong is found. The
    last 32 results are cached, as several calls may use the same view.

    start: the arm's configuration if the view states none.
    """
    q = start if view.configuration is None else view.configuration
    return _camera_note(view, robot, tuple(q.tolist()))


@lru_cache(maxsize=32)
def _camera_note(view: DepthView, robot: Robot, joint_values: tuple[float, ...]) -> str:
    q = np.array(joint_values)
    if wrong := implausible(view):
        return wrong
    agreed, through, count = agreement(view, robot, q)
    if count >= MIN_CELLS and agreed >= MIN_AGREEMENT:
        return ""
    best = ""
    highest = max(MIN_NAMED, BETTER * agreed if count >= MIN_CELLS else 0.0)
    for name, corrected in mistakes(view):
        cells, arm = _images(corrected, robot, q)
        agrees, _, other_count = _compared(cells, arm)
        if other_count < MIN_CELLS or agrees <= highest:
            continue
        if max(_compared(cells, np.roll(arm, shift, (0, 1)))[0] for shift in SHIFTS) < agrees - STANDS_OUT:
            best = name
            highest = agrees
    if best or count < MIN_CELLS or through < MIN_THROUGH:
        return best
    return (
        f"the image sees through {100 * through:.0f} % of where the arm should be: calibrate the camera,"
        " check the joint positions, or state pose_deviation"
    )
