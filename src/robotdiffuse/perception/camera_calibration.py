"""The pose of a camera, estimated from views of the arm: image points are fitted to the arm's surface.

Each image point is matched with the nearest point of the surface; its error is their distance along the
surface's normal (Y. Chen and G. Medioni, "Object modelling by registration of multiple range images", 1992).
Errors are weighted by Geman and McClure's function, whose width shrinks from round to round.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robotdiffuse.core.errors import InputError, check_list
from robotdiffuse.core.transforms import placed, transform
from robotdiffuse.core.types import Configuration, Points, Pose
from robotdiffuse.perception.camera_check import (
    BETTER,
    MIN_CELLS,
    MIN_NAMED,
    STEP_ANGLE,
    agreement,
    mistakes,
)
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.visibility import surface_balls
from robotdiffuse.robots.robot import Robot, check_robot

GATES = np.geomspace(0.15, 0.012, 25)
"""For each round of the estimate, the distance beyond which points are too far from the arm to count [m]."""
MIN_POINTS = 1500
"""Of a view's points near the arm, every k-th is used, with the largest k that leaves at least this many."""
MODEL_CELL = 0.01
"""One point of the arm's surface is used in each cubic cell with this edge [m]."""
NEIGHBORS = 10
"""Number of neighboring points of the surface from which a normal is estimated."""
POINTS_PER_ERROR = 25
"""Number of points that count as one independent measurement in the covariance, because the errors of
neighboring points are correlated."""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """The pose of a camera, estimated from views of the arm."""

    T_base_camera: Pose
    covariance: Float[ndarray, "6 6"]
    """Covariance of the camera's position [m] and rotation vector [rad], in the base frame."""
    agreement: float
    """Of the image cells in which the arm's model is visible, the fraction whose measured depth agrees with
    the model's."""

    @property
    def pose_deviation(self) -> tuple[float, float]:
        """Twice the standard deviation of the position [m] and of the angle [rad], for
        `DepthView.pose_deviation`."""
        position, angle = (
            2 * float(np.sqrt(np.trace(self.covariance[i : i + 3, i : i + 3]))) for i in (0, 3)
        )
        return position, angle


def calibrate_camera(views: Sequence[DepthView], robot: Robot) -> CameraCalibration:
    """Estimate the pose of a fixed camera from views of the arm in several configurations.

    Args:
        views: Depth images of one camera, each with the arm's configuration. The estimate begins at their
            `T_base_camera`, which must be within about 10 cm and 5 degrees of the true pose. It may also
            contain one of the usual mistakes (an inverse, the axes of OpenGL, ...), which is undone first.
        robot: The robot in the images.

    Returns:
        The pose, its covariance, and how well the images agree with it.

    Raises:
        InputError: If there are no views, if they differ in `T_base_camera`, if one lacks a configuration, if
            the arm is hardly seen, or if no pose nearby agrees with the images.

    Example:
        ```python
        calibration = rd.calibrate_camera(views, robot)
        view = rd.DepthView(image, K, calibration.T_base_camera, pose_deviation=calibration.pose_deviation)
        ```
    """
    check_robot(robot)
    check_list("views", views, DepthView, "rd.DepthView", least=1)
    each = [(view, q) for view in views if (q := view.configuration) is not None and len(q) == robot.dof]
    if len(each) < len(views):
        raise InputError(
            f"{len(each)} of {len(views)} views have a configuration of {robot.name}'s {robot.dof} joints; "
            "calibrate_camera needs one for each"
        )
    first, q = each[0]
    if any(not np.allclose(view.T_base_camera, first.T_base_camera) for view in views):
        raise InputError("views differ in T_base_camera; calibrate_camera takes views of one fixed camera")
    # mistakes in the intrinsics are left alone: the estimate is of the pose only
    candidates = [first, *(view for _, view in mistakes(first) if view.intrinsics == first.intrinsics)]
    scores = [s * (count >= MIN_CELLS) for s, _, count in (agreement(v, robot, q) for v in candidates)]
    best = int(np.argmax(scores))
    T = candidates[best if scores[best] > BETTER * scores[0] else 0].T_base_camera
    models = [arm_surface(robot, q) for _, q in each]
    points = [_near_arm(view, T, tree) for (view, _), (tree, _, _) in zip(each, models, strict=True)]
    hessian = np.eye(6)
    spread = 0.0
    # Gauss-Newton steps: A is the Jacobian of the errors e with respect to the camera's position and rotation
    for gate in GATES:
        rows = list[ndarray]()
        errors = list[ndarray]()
        for (tree, surface, normals), in_camera in zip(models, points, strict=True):
            at = placed(T, in_camera)
            distance, near = map(np.asarray, tree.query(at, distance_upper_bound=gate))
            close = np.flatnonzero(np.isfinite(distance))
            normal = normals[near[close]]
            rows.append(np.hstack([normal, np.cross(at[close] - T[:3, 3], normal)]))
            errors.append((normal * (at[close] - surface[near[close]])).sum(axis=1))
        A = np.concatenate(rows)
        e = np.concatenate(errors)
        if len(e) < MIN_CELLS:
            raise InputError(
                f"the arm is hardly seen: {len(e)} points of the views are near it, at least {MIN_CELLS} are "
                "needed; set T_base_camera of the views closer to the true pose, or bring the arm into view"
            )
        weights = 1 / (1 + (e / (0.3 * gate)) ** 2) ** 2
        hessian = (A * weights[:, None]).T @ A + 1e-9 * np.eye(6)
        spread = float(np.sqrt((weights * e**2).sum() / weights.sum()))
        change = -np.linalg.solve(hessian, A.T @ (weights * e))
        turn = Rotation.from_rotvec(change[3:]).as_matrix()
        T = transform(T[:3, 3] + change[:3], turn @ T[:3, :3])
    shares = [agreement(replace(view, T_base_camera=T), robot, q) for view, q in each]
    total = sum(count for _, _, count in shares)
    agrees = sum(share * count for share, _, count in shares) / max(total, 1)
    if agrees < MIN_NAMED:
        raise InputError(
            f"no pose near T_base_camera agrees with the images: the best explains {100 * agrees:.0f} % of "
            "the arm's depths; set T_base_camera of the views closer to the true pose, or check the "
            "intrinsics and the joint positions"
        )
    return CameraCalibration(T, POINTS_PER_ERROR * spread**2 * np.linalg.inv(hessian), agrees)


def arm_surface(robot: Robot, q: Configuration) -> tuple[KDTree, Points, Points]:
    """Points on the arm's surface at a configuration, as a tree and an array [m], and the normals there."""
    centers = surface_balls(robot, q).astype(np.float64)
    points = centers[np.unique(np.floor(centers / MODEL_CELL), axis=0, return_index=True)[1]]
    tree = KDTree(points)
    return tree, points, neighborhoods(points, tree, NEIGHBORS)[1][:, :, 0]


def neighborhoods(points: Points, tree: KDTree, count: int) -> tuple[Points, Float[ndarray, "n 3 3"]]:
    """Extents and principal axes of the `count` points nearest to each point.

    Returns the squared extents [n, 3] along the axes, the smallest first, and the axes as the columns of n
    matrices. If the points lie on a surface, the first axis is its normal.
    """
    around = points[tree.query(points, k=count)[1]]
    off = around - around.mean(axis=1, keepdims=True)
    sizes, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
    return sizes, axes


def _near_arm(view: DepthView, T: Pose, tree: KDTree) -> Points:
    """Points of an image that may be on the arm if the camera is at about T, in the camera's frame [m]."""
    stride = max(1, round(STEP_ANGLE * view.intrinsics[0] / 2))
    intrinsics = np.divide(view.intrinsics, stride)
    points = DepthView(view.depth[::stride, ::stride], intrinsics, np.eye(4)).points()
    distance, _ = tree.query(placed(T, points), distance_upper_bound=2 * GATES[0])
    points = points[np.isfinite(distance)]
    return points[:: max(1, len(points) // MIN_POINTS)]
