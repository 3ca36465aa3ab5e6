"""Camera poses from what the cameras see: a fixed camera's pose from views of the arm, and the refinement of
inexact poses by the arm, known shapes, and surfaces that several images show.

Each point is matched with the nearest point of a surface; its error is their distance along the surface's
normal (Y. Chen and G. Medioni, "Object modelling by registration of multiple range images", 1992). Errors are
weighted by Geman and McClure's function, whose width shrinks from round to round. In the refinement, the
unknowns are the error of each camera's pose, which is constant in the camera's frame, and the distance
between the arm's surface and its model; the stated `pose_deviation` serves as the prior.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robotdiffuse.core.errors import InputError, check_list
from robotdiffuse.core.transforms import placed, transform
from robotdiffuse.core.types import Configuration, Mask, Points, Pose, Values, frozen_dataclass
from robotdiffuse.perception.camera_check import (
    BETTER,
    MIN_CELLS,
    MIN_NAMED,
    STEP_ANGLE,
    agreement,
    mistakes,
)
from robotdiffuse.perception.depth_filter import filtered, grown_for_errors, pose_error
from robotdiffuse.perception.depth_view import DepthView, unprojected
from robotdiffuse.perception.seen_points import ARM_DISTANCE, nearest_surfaces, sphere_distances
from robotdiffuse.perception.visibility import surface_balls
from robotdiffuse.perception.voxel_grid import MAP
from robotdiffuse.robots.robot import Robot, check_robot
from robotdiffuse.scenes.scene import Scene

ARM_GATES = np.geomspace(0.15, 0.012, 60)
"""For each round of the estimate, the distance beyond which points are too far from the arm to count [m]."""
MIN_POINTS = 1500
"""Every k-th of a view's points near the arm is used, with the largest k that leaves at least this many."""
MODEL_CELL = 0.01
"""One point of the arm's surface is used in each cubic cell with this edge [m]."""
ARM_NEIGHBORS = 10
"""Number of neighboring points of the surface from which a normal is estimated."""
ARM_POINTS_PER_ERROR = 25
"""Number of points that count as one independent measurement in the covariance, because the errors of
neighboring points are correlated."""


@frozen_dataclass
class CameraCalibration:
    """The pose of a camera, estimated from views of the arm."""

    T_base_camera: Pose
    covariance: Float[ndarray, "6 6"]
    """Covariance of the camera's position [m] and rotation vector [rad], in the base frame."""
    agreement: float
    """Fraction of the image cells in which the measured depth agrees with the model's, among those in which
    the model is visible."""

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
    for gate in ARM_GATES:
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
    return CameraCalibration(T, ARM_POINTS_PER_ERROR * spread**2 * np.linalg.inv(hessian), agrees)


def arm_surface(robot: Robot, q: Configuration) -> tuple[KDTree, Points, Points]:
    """Points on the arm's surface at a configuration, as a tree and an array [m], and the normals there."""
    centers = surface_balls(robot, q).astype(np.float64)
    points = centers[np.unique(np.floor(centers / MODEL_CELL), axis=0, return_index=True)[1]]
    tree = KDTree(points)
    return tree, points, neighborhoods(points, tree, ARM_NEIGHBORS)[1][:, :, 0]


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
    distance, _ = tree.query(placed(T, points), distance_upper_bound=2 * ARM_GATES[0])
    points = points[np.isfinite(distance)]
    return points[:: max(1, len(points) // MIN_POINTS)]


MAX_VIEWS = 8
"""Maximum number of images by which the pose of one camera is refined."""
MAX_CAMERAS = 8
"""Maximum number of cameras whose poses are refined. A camera that moves beside the arm counts as a new one
at each of its poses."""
MIN_TURN = 0.1
"""An image is used only if a joint of the arm differs by more than this from each earlier image [rad]."""
COLUMNS = 80
"""Approximate number of blocks of pixels in a row of an image. Each block gives one point, of mean depth."""
SAME_SURFACE = 1.1
"""Largest ratio of two depths in a block that sees one surface."""
MAX_POINTS = 600
"""Maximum number of points on the arm that are matched in an image, and of points elsewhere."""
NEIGHBORS = 13
"""Number of points from which a normal is estimated."""
MAX_THICKNESS = 0.3
"""A surface is flat if the thickness of NEIGHBORS points is below this fraction of their width."""
ALIKE = 0.8
"""Smallest cosine of the angle between the normals of matched points."""
FACING = 0.4
"""Smallest cosine of the angle between the arm's normal and the ray."""
GATES = (1.0, 0.7, 0.5, 0.3, 0.2, 0.2)
"""One factor for each round. Matched points are closer to the surface than this factor times `_Image.shift`,
plus NOISES standard deviations of their noise."""
NOISES = 3.0
POINTS_PER_ERROR = 4
"""Number of points that count as one independent measurement."""
KNOWN_ERROR = 0.001
"""Standard deviation of the difference between a surface of the known scene and its model [m]."""
ARM_ERROR = 0.004
"""Standard deviation of the difference between the arm's surface and its model [m]."""
ARM_OFFSET = 0.01
"""Standard deviation of the mean distance between the arm's surface and that of its model [m]."""
FAR = 0.2
"""Surfaces farther from a point than this are not matched with it [m]."""
OTHERS = 8
"""Number of nearest points among which a point of another image is searched for."""
LEAST_STATED = 1e-5
"""A stated deviation of 0 counts as this: [m] or [rad]."""
PRIOR_DEVIATIONS = 1.5
"""Number of standard deviations in the `pose_deviation` that users state."""
DEVIATIONS = 2.5
"""Number of standard deviations in the `pose_deviation` of a refined pose."""
MIN_DEVIATION = (0.002, 0.002)
"""Smallest deviation of a refined pose: position [m] and angle [rad]. No arm is more accurate."""
IMPLAUSIBLE = 2.0
"""An estimated error is rejected if it exceeds the stated deviation by more than this factor."""
DEPTHS = np.arange(0.2, 3.0, 0.2)
"""Depths at which the error of a refined pose is evaluated [m]."""
NEAR = 0.6
"""Up to this distance, the whole error of a refined pose counts as an error of its position [m]."""
SAME_CAMERA = 0.1
"""A camera counts as the one on the arm if each entry of its pose differs from the nominal pose by less than
this: [m], without unit for the rotation."""


class _Match(NamedTuple):
    """Points that are matched with surfaces."""

    derivatives: Float[ndarray, "n unknowns"]
    """Derivatives of the distances."""
    distances: Values
    """Distances of the points from the surfaces, along their normals [m]."""
    noise: Values
    """Standard deviations of the distances [m]."""
    limits: Values
    """Largest distances of matched points [m]."""


@dataclass(eq=False)
class _Camera:
    """A camera, and the estimated error of its pose."""

    link: str | None
    """The link that carries the camera; None: the camera stands beside the arm."""
    T: Pose
    """Nominal pose, in the frame of the link or of the base."""
    stated: Float[ndarray, "6"]
    """Standard deviations of the error according to the stated `pose_deviation`."""
    error: Float[ndarray, "6"]
    """Estimated error: position [m] and rotation vector [rad], in the camera's frame."""
    covariance: Float[ndarray, "6 6"]
    """Covariance of the estimate."""


@frozen_dataclass
class _Image:
    """The parts of a view that the estimate uses."""

    camera: int
    """Index of the camera."""
    T: Pose
    """T_base_camera as the view states it."""
    configuration: Configuration
    points: Points
    """Points in the camera's frame [m]."""
    normals: Points
    """Normals at the points, towards the camera."""
    noise: Values
    """Standard deviations of the points' depths [m]."""
    shift: Values
    """How far the stated error of the pose may displace each point [m]."""
    arm: Mask
    """Which points are on the arm; they are matched with the arm's surface."""
    surface: tuple[KDTree, Points, Points] | None
    """The arm's surface, see `arm_surface`; None without points on the arm."""


class PoseRefinement:
    """The poses of cameras, refined image by image. Views that state no `pose_deviation` are not changed."""

    def __init__(self, robot: Robot, known: Scene, on_arm: Sequence[tuple[str, Pose]]) -> None:
        """known: shapes whose poses are exact. on_arm: link and nominal T_link_camera of each camera on the
        arm."""
        self._robot = robot
        self._known = known
        self._on_arm = on_arm
        self._cameras = list[_Camera]()
        self._images = list[_Image]()

    def observe(self, view: DepthView) -> DepthView:
        """Take a view into account, and return it with its refined pose."""
        q = view.configuration
        number = self._camera(view)
        if number is None or q is None:  # `_camera` returns None if q is None; this is for type checkers
            return view
        earlier = [image for image in self._images if image.camera == number]
        if len(earlier) < MAX_VIEWS and all(np.abs(s.configuration - q).max() > MIN_TURN for s in earlier):
            # a camera beside the arm sees the same scene in each image: only that of its first image counts
            use_scene = self._cameras[number].link is not None or not earlier
            image = self._image(view, q, number, use_scene)
            if len(image.points):
                self._images.append(image)
                self._fit()
        return self.refined(view)

    def refined(self, view: DepthView) -> DepthView:
        """The view with the pose and the deviation estimated from all views so far. It is returned unchanged
        if the estimate is implausible."""
        number = self._camera(view)
        if number is None:
            return view
        camera = self._cameras[number]
        sizes = np.linalg.norm(camera.error.reshape(2, 3), axis=1)
        if (sizes > IMPLAUSIBLE * np.maximum(view.pose_deviation, LEAST_STATED)).any():
            return view
        T = view.T_base_camera @ _pose(camera.error)
        return replace(view, T_base_camera=T, pose_deviation=_deviation(view, T, camera.covariance))

    def mount(self, T: Pose, q: Configuration) -> int | None:
        """The index of the camera on the arm that is nearest to T = T_base_camera; None if it differs by
        SAME_CAMERA or more."""
        off = [float(np.abs(T - self._robot.fk(q, link) @ nominal).max()) for link, nominal in self._on_arm]
        return int(np.argmin(off)) if min(off, default=SAME_CAMERA) < SAME_CAMERA else None

    def _camera(self, view: DepthView) -> int | None:
        """The index of a view's camera, which is added if it is new. None if there are MAX_CAMERAS others, or
        if the view states no error of its pose, was made from a cloud, or lacks the configuration."""
        q = view.configuration
        if not any(view.pose_deviation) or view.cloud is not None or q is None:
            return None
        T = view.T_base_camera
        mount = self.mount(T, q)
        link, nominal = (None, T) if mount is None else self._on_arm[mount]
        for number, camera in enumerate(self._cameras):
            if camera.link == link and np.allclose(nominal, camera.T):
                return number
        if len(self._cameras) == MAX_CAMERAS:
            return None
        stated = np.repeat(np.maximum(view.pose_deviation, LEAST_STATED), 3) / PRIOR_DEVIATIONS
        camera = _Camera(link, nominal, stated, np.zeros(6), np.diag(stated**2))
        self._cameras.append(camera)
        return len(self._cameras) - 1

    def _image(self, view: DepthView, q: Configuration, camera: int, use_scene: bool) -> _Image:
        T = view.T_base_camera
        points = _block_points(view)
        normals, flat = _normals(points)
        spread = filtered(view).spread
        spheres = grown_for_errors(self._robot.placed_spheres(q), view).astype(np.float32)
        on_arm = sphere_distances(placed(T, points), spheres) < ARM_DISTANCE
        arm = on_arm if self._cameras[camera].link is None else np.zeros(len(points), np.bool_)
        use = np.zeros(len(points), np.bool_)
        for usable in (arm, flat & ~on_arm & use_scene):
            at = np.flatnonzero(usable)
            use[at[:: max(1, -(-len(at) // MAX_POINTS))]] = True
        points = points[use]
        noise = spread * points[:, 2] ** 2
        shift = pose_error(view, np.linalg.norm(points, axis=1))
        surface = arm_surface(self._robot, q) if arm.any() else None
        return _Image(camera, T, q, points, normals[use], noise, shift, arm[use], surface)

    def _fit(self) -> None:
        """Estimate the errors of all poses from all images by Gauss-Newton steps.

        The unknowns are six numbers for each camera, see `_Camera.error`, and the arm's offset [m].
        """
        prior = np.concatenate([*(camera.stated for camera in self._cameras), [ARM_OFFSET]]) ** -2
        unknowns = np.concatenate([*(camera.error for camera in self._cameras), np.zeros(1)])
        hessian = np.diag(prior)
        for gate in GATES:
            hessian = np.diag(prior)
            gradient = prior * unknowns
            for match in self._matches(unknowns, gate):
                # Geman and McClure's weights, over the variance of the distances (at least noise ** 2)
                weights = 1 / (1 + (match.distances / (0.5 * match.limits)) ** 2) ** 2
                variance = (weights * (match.distances / match.noise) ** 2).sum() / max(weights.sum(), 1e-9)
                weights /= match.noise**2 * max(variance, 1.0) * POINTS_PER_ERROR
                hessian += (match.derivatives * weights[:, None]).T @ match.derivatives
                gradient += match.derivatives.T @ (weights * match.distances)
            unknowns = unknowns - np.linalg.solve(hessian, gradient)
        covariance = np.linalg.inv(hessian)
        for i, camera in enumerate(self._cameras):
            columns = slice(6 * i, 6 * i + 6)
            camera.error = unknowns[columns]
            camera.covariance = covariance[columns, columns]

    def _matches(self, unknowns: Values, gate: float) -> Iterator[_Match]:
        """Matches the points of each image with the arm, the known shapes, and the points of other images."""
        poses = [s.T @ _pose(unknowns[6 * s.camera : 6 * s.camera + 6]) for s in self._images]
        # all points of the scene, in the base frame: `owners` are their images, `numbers` their rows in them
        scene = [~image.arm for image in self._images]
        owners = np.concatenate([np.full(mask.sum(), i) for i, mask in enumerate(scene)])
        numbers = np.concatenate([np.flatnonzero(mask) for mask in scene])
        every = zip(self._images, poses, scene, strict=True)
        placed_points = [(placed(T, s.points[mask]), s.normals[mask] @ T[:3, :3].T) for s, T, mask in every]
        points, normals = (np.concatenate(parts) for parts in zip(*placed_points, strict=True))
        tree = KDTree(points)

        def match(i: int, use: ndarray, n: Points, r: Values, error: float) -> _Match:
            """The match of points `use` of image i with surfaces.

            n: the surfaces' normals in the base frame. r: the points' distances from the surfaces [m].
            error: standard deviation of the surfaces [m].
            """
            image = self._images[i]
            rows = np.zeros((len(use), len(unknowns)))
            m = n @ poses[i][:3, :3]  # normals in the camera's frame
            columns = slice(6 * image.camera, 6 * image.camera + 6)
            rows[:, columns] = np.hstack([m, np.cross(image.points[use], m)])
            noise = np.hypot(image.noise[use], error)
            return _Match(rows, r, noise, gate * image.shift[use] + NOISES * noise)

        for i, (image, T) in enumerate(zip(self._images, poses, strict=True)):
            if image.surface is not None:
                use = np.flatnonzero(image.arm)
                at = placed(T, image.points[use])
                tree_of_arm, surface, surface_normals = image.surface
                near = np.asarray(tree_of_arm.query(at)[1])
                n = surface_normals[near]
                offset = at - surface[near]
                ray = T[:3, 3] - at
                facing = (ray * n).sum(axis=1) / np.linalg.norm(ray, axis=1)
                n = n * np.sign(facing)[:, None]
                matched = match(i, use, n, (offset * n).sum(axis=1) - unknowns[-1], ARM_ERROR)
                matched.derivatives[:, -1] = -1.0
                is_near = np.linalg.norm(offset, axis=1) < matched.limits + ARM_OFFSET
                yield _selected(matched, is_near & (np.abs(facing) > FACING))
            use = np.flatnonzero(~image.arm)
            mine = owners == i
            if self._known.shapes:
                surfaces = nearest_surfaces(self._robot, self._known, points[mine], FAR).astype(np.float64)
                n = surfaces[:, 1:]
                matched = match(i, use, n, surfaces[:, 0], KNOWN_ERROR)
                yield _selected(matched, (n * normals[mine]).sum(axis=1) > ALIKE)
            if self._cameras[image.camera].link is None or not len(use):
                continue
            # the nearest point of another image; its distance also depends on that image's pose
            distances, near = map(np.asarray, tree.query(points[mine], OTHERS, distance_upper_bound=FAR))
            other = np.isfinite(distances) & (np.append(owners, i)[near] != i)
            ok = other.any(axis=1)
            near = near[np.arange(len(near)), other.argmax(axis=1)][ok]
            n = normals[near]
            matched = match(i, use[ok], n, ((points[mine][ok] - points[near]) * n).sum(axis=1), KNOWN_ERROR)
            for j in np.unique(owners[near]).tolist():
                rows = owners[near] == j
                opposite = match(j, numbers[near[rows]], n[rows], matched.distances[rows], KNOWN_ERROR)
                matched.derivatives[rows] -= opposite.derivatives
                matched.noise[rows] = np.hypot(matched.noise[rows], opposite.noise)
                matched.limits[rows] += opposite.limits
            yield _selected(matched, (n * normals[mine][ok]).sum(axis=1) > ALIKE)


def _selected(match: _Match, ok: Mask) -> _Match:
    """The rows of a match that are `ok` and whose distances are within their limits."""
    ok = ok & (np.abs(match.distances) < match.limits)
    return _Match(*(values[ok] for values in match))


def _pose(error: Float[ndarray, "6"]) -> Pose:
    return transform(error[:3], Rotation.from_rotvec(error[3:]).as_matrix())


def _deviation(view: DepthView, T: Pose, covariance: Float[ndarray, "6 6"]) -> tuple[float, float]:
    """The `pose_deviation` of a refined pose: a position [m] and an angle [rad] that bound how far its error
    displaces points in the map. Their sum is at most that of the stated deviation.

    The position bounds displacements along rays, and any displacement of points nearer than NEAR. The angle
    bounds the other displacements, in proportion to the distance.
    """
    height, width = view.depth.shape
    u, v, z = (a.ravel() for a in np.meshgrid((0, width / 2, width), (0, height / 2, height), DEPTHS))
    points = unprojected(view, u, v, z)
    points = points[MAP.contains(MAP.indices(placed(T, points)))]
    if not len(points):
        return view.pose_deviation
    # derivatives of the points' displacements with respect to the pose's error, and their covariances
    turned = np.cross(np.eye(3), points[:, None]).swapaxes(1, 2)
    shifts = np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), turned], axis=2)
    spread = shifts @ covariance @ shifts.swapaxes(1, 2)
    far = np.linalg.norm(points, axis=1)
    along = DEVIATIONS * np.sqrt(np.einsum("ni,nij,nj->n", points, spread, points)) / far
    largest = DEVIATIONS * np.sqrt(np.linalg.eigvalsh(spread)[:, -1])
    position = max(float(along.max()), float(largest[far < NEAR].max(initial=MIN_DEVIATION[0])))
    angle = max(float(((largest - position) / far).max()), MIN_DEVIATION[1])
    return min((position, angle), view.pose_deviation, key=sum)  # the sum is the error at 1 m


def _block_points(view: DepthView) -> Points:
    """A point at the mean depth of each block of pixels that sees one surface, in the camera's frame [m]."""
    size = max(2, view.depth.shape[1] // COLUMNS)
    rows, columns = (n // size for n in view.depth.shape)
    blocks = view.depth[: rows * size, : columns * size].reshape(rows, size, columns, size)
    seen = np.isfinite(blocks) & (blocks > 0)
    nearest = np.where(seen, blocks, np.inf).min(axis=(1, 3))
    count = seen.sum(axis=(1, 3))
    depths = np.where(seen, blocks, 0.0)
    ok = (count > 0.9 * size**2) & (depths.max(axis=(1, 3)) < SAME_SURFACE * nearest)
    v, u = np.nonzero(ok)
    z = depths.sum(axis=(1, 3))[ok].astype(np.float64) / count[ok]
    half = (size - 1) / 2
    return unprojected(view, size * u + half, size * v + half, z)


def _normals(points: Points) -> tuple[Points, Mask]:
    """The normals at points in the camera's frame, towards the camera; and which points are on a flat
    surface."""
    if len(points) <= NEIGHBORS:
        return np.zeros((len(points), 3)), np.zeros(len(points), np.bool_)
    sizes, axes = neighborhoods(points, KDTree(points), NEIGHBORS)
    normals = axes[:, :, 0]
    normals = normals * -np.sign((normals * points).sum(axis=1))[:, None]
    return normals, sizes[:, 0] < MAX_THICKNESS**2 * sizes[:, 1]
