"""A camera checked against the arm that it sees: mistakes in its pose and intrinsics are named, and its pose
is estimated from views of the arm, by the distances of image points to the arm's surface."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import transform
from robotdiffuse.core.types import Configuration, Points, Pose
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.ray_caster import ray_cast
from robotdiffuse.perception.visibility import surface_balls
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
BETTER = 1.5
"""A mistake is named if without it the agreement is this many times as high."""
NOTED_OFFSET = (0.015, 0.015)
"""Offsets of a camera from where the arm shows it, beyond the stated deviation, that are noted [m], [rad]."""
GATES = np.geomspace(0.15, 0.012, 25)
"""Points farther from the arm than this do not count, in rounds of the estimate [m]."""
MAX_POINTS = 1500
"""Points of a view that an estimate uses."""
MODEL_CELL = 0.01
"""One point of the arm's surface is used for each cell of this edge [m]."""
NEIGHBOURS = 10
"""Points of the surface that its normal is estimated from."""
POINTS_PER_ERROR = 25
"""So many neighbouring points have about one error in common."""
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""T_link_optical: x ahead, y left and z up, as ROS has bodies, to the optical frame."""
FOCAL_FACTORS = (0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0)


def agreement(view: DepthView, robot: Robot, q: Configuration) -> tuple[float, int]:
    """The part of the cells of an image with the arm in them whose depth is the arm's, and their number."""
    step = max(1, round(STEP_ANGLE * view.intrinsics[0]))
    cells = view.depth[step // 2 :: step, step // 2 :: step]
    fx, fy, cx, cy = view.intrinsics
    coarse = (fx / step, fy / step, (cx - step // 2) / step, (cy - step // 2) / step)
    arm = ray_cast(NOTHING, view.T_base_camera, coarse, cells.shape[::-1], robot, q).depth
    told = np.isfinite(arm) & (cells > 0)
    with np.errstate(invalid="ignore"):
        same = np.abs(cells - arm - SPHERES_AHEAD)[told] < SAME_DEPTH
    return (float(same.mean()) if told.any() else 0.0), int(told.sum())


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
    little."""
    q = start if view.configuration is None else view.configuration
    found, count = agreement(view, robot, q)
    if count >= MIN_CELLS and found >= MIN_AGREEMENT:
        return ""
    best = ""
    highest = max(MIN_AGREEMENT, BETTER * found if count >= MIN_CELLS else 0.0)
    for name, other in mistakes(view):
        agrees, cells = agreement(other, robot, q)
        if cells >= MIN_CELLS and agrees > highest:
            best = name
            highest = agrees
    if best or count < MIN_CELLS:
        return best
    try:
        estimate = calibrate_camera([view], robot, start)
    except InputError:
        return ""
    if estimate.agreement < max(MIN_AGREEMENT, BETTER * found):
        return ""
    away, angle = offset(view.T_base_camera, estimate.T_base_camera)
    stated = view.pose_deviation
    if away < stated[0] + NOTED_OFFSET[0] and angle < stated[1] + NOTED_OFFSET[1]:
        return ""
    return (
        f"the arm shows the camera {1e3 * away:.0f} mm and {np.degrees(angle):.1f} degrees off"
        " T_base_camera: calibrate it (rd.calibrate_camera), or state pose_deviation"
    )


def offset(first: Pose, second: Pose) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    turn = Rotation.from_matrix(first[:3, :3].T @ second[:3, :3])
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3])), float(turn.magnitude())


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """The pose of a camera, as views of the arm show it."""

    T_base_camera: Pose
    covariance: Float[ndarray, "6 6"]
    """Of the position [m] and the rotation vector [rad] of the camera, in the base frame."""
    agreement: float
    """Part of the image cells with the arm in them that have its depth."""

    @property
    def pose_deviation(self) -> tuple[float, float]:
        """Two standard deviations, for `DepthView.pose_deviation`: position [m] and angle [rad]."""
        position, angle = (
            2 * float(np.sqrt(np.trace(self.covariance[i : i + 3, i : i + 3]))) for i in (0, 3)
        )
        return position, angle


def calibrate_camera(
    views: Sequence[DepthView], robot: Robot, start: Configuration | None = None
) -> CameraCalibration:
    """Estimate the pose of a camera that stands, from views of the arm in several configurations.

    Args:
        views: Depth images of one camera, each with the arm's configuration. Their `T_base_camera` is where
            the search begins: within about 10 cm and 5 degrees, or one of the usual mistakes away.
        robot: The robot in the images.
        start: The configuration of views without one.

    Returns:
        The pose, its covariance, and how well the images agree with it.

    Raises:
        InputError: Without a view, and where the arm is not seen.
    """
    seen = [(view, start if view.configuration is None else view.configuration) for view in views]
    if not seen or any(q is None for _, q in seen):
        raise InputError("calibrate_camera needs views, each with the arm's configuration")
    each = [(view, q) for view, q in seen if q is not None]
    first, q = each[0]
    begins = [first, *(other for _, other in mistakes(first) if other.intrinsics == first.intrinsics)]
    scored = [agreement(view, robot, q) for view in begins]
    best = max(range(len(begins)), key=lambda i: scored[i][0] * (scored[i][1] >= MIN_CELLS))
    T = begins[best].T_base_camera if scored[best][0] > BETTER * scored[0][0] else first.T_base_camera
    models = [_surface(robot, q) for _, q in each]
    points = [_near_arm(view, T, tree) for (view, _), (tree, _, _) in zip(each, models, strict=True)]
    hessian = np.eye(6)
    spread = 0.0
    for gate in GATES:
        rows, errors = list[ndarray](), list[ndarray]()
        for (tree, surface, normals), in_camera in zip(models, points, strict=True):
            at = in_camera @ T[:3, :3].T + T[:3, 3]
            distance, near = tree.query(at, distance_upper_bound=gate)
            close = np.flatnonzero(np.isfinite(distance))
            normal = normals[near[close]]
            rows.append(np.hstack([normal, np.cross(at[close] - T[:3, 3], normal)]))
            errors.append((normal * (at[close] - surface[near[close]])).sum(axis=1))
        A = np.concatenate(rows)
        e = np.concatenate(errors)
        if len(e) < MIN_CELLS:
            raise InputError(f"the arm is hardly seen: {len(e)} points of the views are near it")
        weights = 1 / (1 + (e / (0.3 * gate)) ** 2) ** 2
        hessian = (A * weights[:, None]).T @ A + 1e-9 * np.eye(6)
        spread = float(np.sqrt((weights * e**2).sum() / weights.sum()))
        change = -np.linalg.solve(hessian, A.T @ (weights * e))
        turn = Rotation.from_rotvec(change[3:]).as_matrix()
        T = transform(T[:3, 3] + change[:3], turn @ T[:3, :3])
    shares = [agreement(replace(view, T_base_camera=T), robot, q) for view, q in each]
    total = sum(count for _, count in shares)
    agrees = sum(share * count for share, count in shares) / max(total, 1)
    return CameraCalibration(T, POINTS_PER_ERROR * spread**2 * np.linalg.inv(hessian), agrees)


def _surface(robot: Robot, q: Configuration) -> tuple[KDTree, Points, Points]:
    """Points on the arm's surface at a configuration, as a tree and an array [m], and the normals there."""
    balls = surface_balls(robot, q).astype(np.float64)
    points = balls[np.unique(np.floor(balls / MODEL_CELL), axis=0, return_index=True)[1]]
    tree = KDTree(points)
    around = points[tree.query(points, k=NEIGHBOURS)[1]]
    off = around - around.mean(axis=1, keepdims=True)
    return tree, points, np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))[1][:, :, 0]


def _near_arm(view: DepthView, T: Pose, tree: KDTree) -> Points:
    """Points of an image in the camera's frame that are near the arm if the camera is about at T."""
    fx, fy, cx, cy = view.intrinsics
    stride = max(1, round(STEP_ANGLE * fx / 2))
    depth = view.depth[::stride, ::stride].astype(np.float64)
    v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
    z = depth[v, u]
    points = np.stack([(stride * u - cx) / fx * z, (stride * v - cy) / fy * z, z], axis=1)
    distance, _ = tree.query(points @ T[:3, :3].T + T[:3, 3], distance_upper_bound=2 * GATES[0])
    points = points[np.isfinite(distance)]
    return points[:: max(1, len(points) // MAX_POINTS)]
