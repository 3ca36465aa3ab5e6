"""Refines inexact camera poses by what the cameras see: the arm, known shapes, and surfaces that several
images show.

Points are matched with the nearest point of a surface, along its normal, as in `camera_calibration`. The
unknowns are the error of each camera's pose, which is constant in the camera's frame, and the distance
between the arm's surface and its model. The stated `pose_deviation` serves as the prior.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robotdiffuse.core.transforms import placed, transform
from robotdiffuse.core.types import Configuration, Points, Pose, Values
from robotdiffuse.perception.camera_calibration import arm_surface, neighborhoods
from robotdiffuse.perception.depth_filter import filtered, grown_for_errors, pose_error
from robotdiffuse.perception.depth_view import DepthView, unprojected
from robotdiffuse.perception.seen_points import ARM_DISTANCE, nearest_surfaces, sphere_distances
from robotdiffuse.perception.voxel_grid import MAP
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

MAX_VIEWS = 8
"""Maximum number of images by which the pose of one camera is refined."""
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
"""One factor for each round. Matched points are at most this factor times `_Image.shift`, plus NOISES
standard deviations of their noise, from the surface."""
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
"""A camera is that of a nominal pose on the arm if no entry of its pose differs by more: [m], or without unit
for the rotation."""


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


@dataclass(frozen=True, eq=False)
class _Image:
    """The parts of a view that the estimate uses."""

    camera: int
    """Index of the camera."""
    T: Pose
    """T_base_camera as the view states it."""
    configuration: Configuration
    shows_scene: bool
    """Whether points of the scene are used; for a camera beside the arm, only in its first image."""
    points: Points
    """Points in the camera's frame [m]."""
    normals: Points
    """Normals at the points, towards the camera."""
    noise: Values
    """Standard deviations of the points' depths [m]."""
    shift: Values
    """How far the stated error of the pose may displace each point [m]."""
    arm: Bool[ndarray, "n"]
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
        if not any(view.pose_deviation) or view.cloud is not None or q is None:
            return view
        number = self._camera(view, q)
        earlier = [image for image in self._images if image.camera == number]
        if len(earlier) < MAX_VIEWS and all(np.abs(s.configuration - q).max() > MIN_TURN for s in earlier):
            shows_scene = self._cameras[number].link is not None or not earlier
            image = self._image(view, q, number, shows_scene)
            if len(image.points):
                self._images.append(image)
                self._fit()
        return self.refined(view)

    def refined(self, view: DepthView) -> DepthView:
        """The view with the pose and the deviation estimated from all views so far. It is returned unchanged
        if the estimate is implausible."""
        q = view.configuration
        if not any(view.pose_deviation) or view.cloud is not None or q is None:
            return view
        camera = self._cameras[self._camera(view, q)]
        sizes = np.linalg.norm(camera.error.reshape(2, 3), axis=1)
        if (sizes > IMPLAUSIBLE * np.array(view.pose_deviation)).any():
            return view
        T = view.T_base_camera @ _pose(camera.error)
        return replace(view, T_base_camera=T, pose_deviation=_deviation(view, T, camera.covariance))

    def _camera(self, view: DepthView, q: Configuration) -> int:
        """The index of a view's camera, which is added if it is new."""
        T = view.T_base_camera
        for number, camera in enumerate(self._cameras):
            if camera.link is None and np.allclose(T, camera.T):
                return number
            if camera.link is not None and is_on(self._robot, camera.link, camera.T, T, q):
                return number
        stated = np.repeat(np.maximum(view.pose_deviation, 1e-5), 3) / PRIOR_DEVIATIONS
        link, nominal = next((mount for mount in self._on_arm if is_on(self._robot, *mount, T, q)), (None, T))
        camera = _Camera(link, nominal, stated, np.zeros(6), np.diag(stated**2))
        self._cameras.append(camera)
        return len(self._cameras) - 1

    def _image(self, view: DepthView, q: Configuration, camera: int, shows_scene: bool) -> _Image:
        T = view.T_base_camera
        points = _block_points(view)
        normals, flat = _normals(points)
        spread = filtered(view).spread
        spheres = grown_for_errors(self._robot.placed_spheres(q), view).astype(np.float32)
        on_arm = sphere_distances(placed(T, points), spheres) < ARM_DISTANCE
        beside_arm = self._cameras[camera].link is None
        arm = on_arm if beside_arm else np.zeros(len(points), np.bool_)
        use = np.zeros(len(points), np.bool_)
        for usable in (arm, flat & ~on_arm & shows_scene):
            at = np.flatnonzero(usable)
            use[at[:: max(1, -(-len(at) // MAX_POINTS))]] = True
        points = points[use]
        noise = spread * points[:, 2] ** 2
        shift = pose_error(view, np.linalg.norm(points, axis=1))
        surface = arm_surface(self._robot, q) if arm.any() else None
        return _Image(camera, T, q, shows_scene, points, normals[use], noise, shift, arm[use], surface)

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
            own = slice(6 * i, 6 * i + 6)
            camera.error = unknowns[own]
            camera.covariance = covariance[own, own]

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
            own = slice(6 * image.camera, 6 * image.camera + 6)
            rows[:, own] = np.hstack([m, np.cross(image.points[use], m)])
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


def is_on(robot: Robot, link: str, nominal: Pose, T: Pose, q: Configuration) -> bool:
    """Whether a camera at T = T_base_camera is the camera on `link` with T_link_camera = `nominal`."""
    return bool(np.abs(T - robot.fk(q, link) @ nominal).max() < SAME_CAMERA)


def _selected(match: _Match, ok: Bool[ndarray, "n"]) -> _Match:
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


def _normals(points: Points) -> tuple[Points, Bool[ndarray, "n"]]:
    """The normals at points in the camera's frame, towards the camera; and which points are on a flat
    surface."""
    if len(points) <= NEIGHBORS:
        return np.zeros((len(points), 3)), np.zeros(len(points), np.bool_)
    sizes, axes = neighborhoods(points, KDTree(points), NEIGHBORS)
    normals = axes[:, :, 0]
    normals = normals * -np.sign((normals * points).sum(axis=1))[:, None]
    return normals, sizes[:, 0] < MAX_THICKNESS**2 * sizes[:, 1]
