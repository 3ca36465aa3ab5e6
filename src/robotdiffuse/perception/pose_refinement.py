"""Refines the poses of cameras that are stated inexactly, by what the cameras see: the arm, known shapes, and
surfaces that other images show too.

Points are matched with the nearest point of a surface, along its normal, as in `camera_calibration`. Unknown
are the error of each camera's pose in its own frame, the same in all of its images, and the distance between
the arm's surface and its model. What is stated of the errors is a prior.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robotdiffuse.collision.kernel_arrays import compile_scene_for
from robotdiffuse.collision.kernels.collision_cost import scene_distance
from robotdiffuse.core.kernels import kernel
from robotdiffuse.core.transforms import placed, transform
from robotdiffuse.core.types import Configuration, Points, Pose, Values
from robotdiffuse.perception.camera_calibration import arm_surface, neighborhoods
from robotdiffuse.perception.depth_filter import filtered, grown_for_errors, pose_error
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.seen_points import ARM_DISTANCE, sphere_distances
from robotdiffuse.perception.voxel_grid import MAP
from robotdiffuse.robots.kinematics import link_poses, placed_spheres
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

MAX_VIEWS = 8
"""Images of a camera that its pose is refined by."""
MIN_TURN = 0.1
"""Images with the arm nearer than this to where it was in another one tell nothing new [rad]."""
COLUMNS = 80
"""Blocks of pixels in a row of an image; their mean depths are used."""
SAME_SURFACE = 1.1
"""Largest ratio of the depths in a block."""
MAX_POINTS = 600
"""Points of an image that are matched."""
NEIGHBORS = 13
"""Points that a normal is estimated from."""
MAX_THICKNESS = 0.3
"""Largest thickness of these, relative to their width."""
ALIKE = 0.8
"""Smallest cosine of the angle between the normals of matched points."""
FACING = 0.4
"""Smallest cosine of the angle between the arm's normal and the ray."""
GATES = (1.0, 0.7, 0.5, 0.3, 0.2, 0.2)
"""Matched points are nearer to each other than this part of what is stated of both, and NOISES standard
deviations of their noise, in rounds."""
NOISES = 3.0
POINTS_PER_ERROR = 4
"""So many points have about one error in common."""
KNOWN_ERROR, ARM_ERROR = 0.001, 0.004
"""Standard deviation of the difference between surfaces of scenes, and of the arm, and their models [m]."""
ARM_OFFSET = 0.01
"""Standard deviation of the distance between the arm's surface and that of its model [m]."""
FAR = 0.2
"""Known shapes farther away than this are not matched [m]."""
OTHERS = 8
"""Nearest points among which there shall be one of another image."""
PRIOR_DEVIATIONS, DEVIATIONS = 1.5, 2.5
"""What is stated of a pose, and what is stated after its refinement, in standard deviations."""
MIN_DEVIATION = (0.002, 0.002)
"""Of refined poses: position [m] and angle [rad]. An arm is not more exact."""
IMPLAUSIBLE = 2.0
"""Estimates that are more than this times what is stated are mistaken."""
DEPTHS = np.arange(0.2, 3.0, 0.2)
"""At which a refined pose's error is bounded [m]."""
NEAR = 0.6
"""Up to this distance the whole error of a refined pose counts as one of position [m]."""
SAME_CAMERA = 0.1
"""Largest difference between entries of the pose of a camera on the arm and of its nominal pose [m], [1]."""


class _Match(NamedTuple):
    """Points and the surfaces that they are matched with."""

    derivatives: Float[ndarray, "n unknowns"]
    """Of the distances."""
    distances: Values
    """Along the normals [m]."""
    noise: Values
    """Standard deviations of the distances [m]."""
    limits: Values
    """Of the distances [m]."""


@dataclass(eq=False)
class _Camera:
    """A camera, and what is known of its pose's error."""

    link: str | None
    T: Pose
    """In the frame of its link, or of the base: nominal."""
    stated: Float[ndarray, "6"]
    """Standard deviations of its error, as stated."""
    error: Float[ndarray, "6"]
    """Position [m] and rotation vector [rad], in the camera's frame."""
    covariance: Float[ndarray, "6 6"]


@dataclass(frozen=True, eq=False)
class _Sight:
    """What is used of an image."""

    camera: int
    T: Pose
    """As stated."""
    configuration: Configuration
    shows_scene: bool
    """A camera that stands shows the scene once."""
    points: Points
    """In the camera's frame [m]."""
    normals: Points
    """Towards the camera."""
    noise: Values
    stated: Values
    """How far off the pose may displace the points [m]."""
    arm: Bool[ndarray, "n"]
    """Points on the arm, which are matched with its surface."""
    surface: tuple[KDTree, Points, Points] | None
    """Of the arm; None without points on it."""


class PoseRefinement:
    """The poses of cameras, refined image by image. Views that state no `pose_deviation` stay as they are."""

    def __init__(self, robot: Robot, known: Scene, on_arm: Sequence[tuple[str, Pose]]) -> None:
        """known: shapes that are exact. on_arm: link and nominal pose of each camera on the arm."""
        self._robot = robot
        self._known = compile_scene_for(robot, known) if known.shapes else None
        self._on_arm = on_arm
        self._cameras = list[_Camera]()
        self._sights = list[_Sight]()

    def observe(self, view: DepthView) -> DepthView:
        """Take a view into account; the view with its refined pose."""
        q = view.configuration
        if not any(view.pose_deviation) or view.cloud is not None or q is None or len(q) != self._robot.dof:
            return view
        number = self._camera(view, q)
        mine = [sight for sight in self._sights if sight.camera == number]
        if len(mine) < MAX_VIEWS and all(np.abs(s.configuration - q).max() > MIN_TURN for s in mine):
            shows_scene = self._cameras[number].link is not None or not mine
            sight = self._sight(view, q, number, shows_scene)
            if len(sight.points):
                self._sights.append(sight)
                self._fit()
        return self.refined(view)

    def refined(self, view: DepthView) -> DepthView:
        """The view with the pose and the deviation that follow from all views so far."""
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
        """The number of a view's camera."""
        T = view.T_base_camera
        for number, camera in enumerate(self._cameras):
            if camera.link is None and np.allclose(T, camera.T):
                return number
            if camera.link is not None and is_on(self._robot, camera.link, camera.T, T, q):
                return number
        stated = np.repeat(np.maximum(view.pose_deviation, 1e-5), 3) / PRIOR_DEVIATIONS
        link, nominal = next((one for one in self._on_arm if is_on(self._robot, *one, T, q)), (None, T))
        camera = _Camera(link, nominal, stated, np.zeros(6), np.diag(stated**2))
        self._cameras.append(camera)
        return len(self._cameras) - 1

    def _sight(self, view: DepthView, q: Configuration, camera: int, shows_scene: bool) -> _Sight:
        T = view.T_base_camera
        points = _block_points(view)
        normals, flat = _normals(points)
        spread = filtered(view).spread
        spheres = grown_for_errors(placed_spheres(self._robot, q), view).astype(np.float32)
        on_arm = sphere_distances(placed(T, points), spheres) < ARM_DISTANCE
        stands = self._cameras[camera].link is None
        arm = on_arm if stands else np.zeros(len(points), np.bool_)
        use = np.zeros(len(points), np.bool_)
        for some in (arm, flat & ~on_arm & shows_scene):
            at = np.flatnonzero(some)
            use[at[:: max(1, -(-len(at) // MAX_POINTS))]] = True
        points = points[use]
        noise = spread * points[:, 2] ** 2
        stated = pose_error(view, np.linalg.norm(points, axis=1))
        surface = arm_surface(self._robot, q) if arm.any() else None
        return _Sight(camera, T, q, shows_scene, points, normals[use], noise, stated, arm[use], surface)

    def _fit(self) -> None:
        """Estimate the errors of all poses by all images."""
        prior = np.concatenate([*(camera.stated for camera in self._cameras), [ARM_OFFSET]]) ** -2
        unknowns = np.concatenate([*(camera.error for camera in self._cameras), np.zeros(1)])
        hessian = np.diag(prior)
        for gate in GATES:
            hessian = np.diag(prior)
            gradient = prior * unknowns
            for match in self._matches(unknowns, gate):
                weights = 1 / (1 + (match.distances / (0.5 * match.limits)) ** 2) ** 2
                variance = (weights * (match.distances / match.noise) ** 2).sum() / max(weights.sum(), 1e-9)
                weights /= match.noise**2 * max(variance, 1.0) * POINTS_PER_ERROR
                hessian += (match.derivatives * weights[:, None]).T @ match.derivatives
                gradient += match.derivatives.T @ (weights * match.distances)
            unknowns = unknowns - np.linalg.solve(hessian, gradient)
        covariance = np.linalg.inv(hessian)
        for i, camera in enumerate(self._cameras):
            of = slice(6 * i, 6 * i + 6)
            camera.error = unknowns[of]
            camera.covariance = covariance[of, of]

    def _matches(self, unknowns: Values, gate: float) -> Iterator[_Match]:
        poses = [s.T @ _pose(unknowns[6 * s.camera : 6 * s.camera + 6]) for s in self._sights]
        scene = [~sight.arm for sight in self._sights]
        owners = np.concatenate([np.full(some.sum(), i) for i, some in enumerate(scene)])
        numbers = np.concatenate([np.flatnonzero(some) for some in scene])
        every = zip(self._sights, poses, scene, strict=True)
        placed_points = [(placed(T, s.points[some]), s.normals[some] @ T[:3, :3].T) for s, T, some in every]
        points, normals = (np.concatenate(parts) for parts in zip(*placed_points, strict=True))
        tree = KDTree(points)

        def match(i: int, use: ndarray, n: Points, r: Values, error: float) -> _Match:
            """Points of an image, by distance and normal of the surfaces nearest to them."""
            sight = self._sights[i]
            rows = np.zeros((len(use), len(unknowns)))
            m = n @ poses[i][:3, :3]
            of = slice(6 * sight.camera, 6 * sight.camera + 6)
            rows[:, of] = np.hstack([m, np.cross(sight.points[use], m)])
            noise = np.hypot(sight.noise[use], error)
            return _Match(rows, r, noise, gate * sight.stated[use] + NOISES * noise)

        for i, (sight, T) in enumerate(zip(self._sights, poses, strict=True)):
            if sight.surface is not None:
                use = np.flatnonzero(sight.arm)
                at = placed(T, sight.points[use])
                tree_of_arm, surface, surface_normals = sight.surface
                near = np.asarray(tree_of_arm.query(at)[1])
                n = surface_normals[near]
                off = at - surface[near]
                ray = T[:3, 3] - at
                facing = (ray * n).sum(axis=1) / np.linalg.norm(ray, axis=1)
                n = n * np.sign(facing)[:, None]
                found = match(i, use, n, (off * n).sum(axis=1) - unknowns[-1], ARM_ERROR)
                found.derivatives[:, -1] = -1.0
                is_near = np.linalg.norm(off, axis=1) < found.limits + ARM_OFFSET
                yield _some(found, is_near & (np.abs(facing) > FACING))
            use = np.flatnonzero(~sight.arm)
            mine = owners == i
            if self._known is not None and len(use):
                surfaces = nearest_surfaces(self._known, points[mine].astype(np.float32)).astype(np.float64)
                n = surfaces[:, 1:]
                found = match(i, use, n, surfaces[:, 0], KNOWN_ERROR)
                yield _some(found, (n * normals[mine]).sum(axis=1) > ALIKE)
            if self._cameras[sight.camera].link is None or not len(use):
                continue
            distances, near = map(np.asarray, tree.query(points[mine], OTHERS, distance_upper_bound=FAR))
            other = np.isfinite(distances) & (np.append(owners, i)[near] != i)
            ok = other.any(axis=1)
            near = near[np.arange(len(near)), other.argmax(axis=1)][ok]
            n = normals[near]
            found = match(i, use[ok], n, ((points[mine][ok] - points[near]) * n).sum(axis=1), KNOWN_ERROR)
            for j in np.unique(owners[near]):
                of = owners[near] == j
                there = match(j, numbers[near[of]], n[of], found.distances[of], KNOWN_ERROR)
                found.derivatives[of] -= there.derivatives
                found.noise[of] = np.hypot(found.noise[of], there.noise)
                found.limits[of] += there.limits
            yield _some(found, (n * normals[mine][ok]).sum(axis=1) > ALIKE)


def is_on(robot: Robot, link: str, nominal: Pose, T: Pose, q: Configuration) -> bool:
    """Whether a camera at T_base_camera is one on a link of the arm with a nominal T_link_camera."""
    return bool(np.abs(T - link_poses(robot, q[None], link)[0] @ nominal).max() < SAME_CAMERA)


@kernel(nogil=True)
def nearest_surfaces(scene, points):
    """Signed distances of points [n, 3] to obstacles of SceneArrays, at most FAR [m], and the normals."""
    out = np.empty((len(points), 4), np.float32)
    for p in range(len(points)):
        out[p] = scene_distance(scene, points[p, 0], points[p, 1], points[p, 2], np.float32(FAR))
    return out


def _some(match: _Match, ok: Bool[ndarray, "n"]) -> _Match:
    """The pairs of these that are near enough."""
    ok = ok & (np.abs(match.distances) < match.limits)
    return _Match(*(values[ok] for values in match))


def _pose(error: Float[ndarray, "6"]) -> Pose:
    return transform(error[:3], Rotation.from_rotvec(error[3:]).as_matrix())


def _deviation(view: DepthView, T: Pose, covariance: Float[ndarray, "6 6"]) -> tuple[float, float]:
    """By how much a refined pose may be off, for points in the map: a distance along rays [m], and an angle
    that stands for the rest [rad]; no more than what is stated."""
    height, width = view.depth.shape
    fx, fy, cx, cy = view.intrinsics
    u, v, z = (a.ravel() for a in np.meshgrid((0, width / 2, width), (0, height / 2, height), DEPTHS))
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=1)
    points = points[MAP.contains(MAP.indices(placed(T, points)))]
    if not len(points):
        return view.pose_deviation
    turned = np.cross(np.eye(3), points[:, None]).swapaxes(1, 2)
    shifts = np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), turned], axis=2)
    spread = shifts @ covariance @ shifts.swapaxes(1, 2)
    far = np.linalg.norm(points, axis=1)
    along = DEVIATIONS * np.sqrt(np.einsum("ni,nij,nj->n", points, spread, points)) / far
    largest = DEVIATIONS * np.sqrt(np.linalg.eigvalsh(spread)[:, -1])
    position = max(float(along.max()), float(largest[far < NEAR].max(initial=MIN_DEVIATION[0])))
    angle = max(float(((largest - position) / far).max()), MIN_DEVIATION[1])
    return min((position, angle), view.pose_deviation, key=sum)  # the error at 1 m


def _block_points(view: DepthView) -> Points:
    """A point for each block of pixels that sees one surface, in the camera's frame [m]."""
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
    fx, fy, cx, cy = view.intrinsics
    half = (size - 1) / 2
    return np.stack([(size * u + half - cx) / fx * z, (size * v + half - cy) / fy * z, z], axis=1)


def _normals(points: Points) -> tuple[Points, Bool[ndarray, "n"]]:
    """Normals towards the camera, and which points lie on a flat surface."""
    if len(points) <= NEIGHBORS:
        return np.zeros((len(points), 3)), np.zeros(len(points), np.bool_)
    sizes, axes = neighborhoods(points, KDTree(points), NEIGHBORS)
    normals = axes[:, :, 0]
    normals = normals * -np.sign((normals * points).sum(axis=1))[:, None]
    return normals, sizes[:, 0] < MAX_THICKNESS**2 * sizes[:, 1]
