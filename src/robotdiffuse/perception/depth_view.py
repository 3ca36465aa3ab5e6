"""DepthView: a depth image, with the camera pose and the arm's configuration when it was taken; and
DepthNoise, the errors of depth cameras, simulated.

As with shapes, the constructor of a view checks its arguments itself: see `no_type_check` in
scenes/shapes.py.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray
from numpy.random import Generator
from numpy.typing import ArrayLike

from robotdiffuse.core.errors import (
    MAX_COORDINATE,
    MAX_RATE,
    InputError,
    check_type,
    form,
    numbers,
    points,
    positive,
    rigid_motion,
    rigid_transform,
    rows,
    shown,
    vector,
)
from robotdiffuse.core.settings import Bound, Positive, Settings, ShareBelowOne
from robotdiffuse.core.transforms import placed, seen_from
from robotdiffuse.core.types import Configuration, Points, Pose, Value, frozen_dataclass, no_type_check
from robotdiffuse.scenes.shapes import PointCloud

INTEGER_NO_RETURN = 65535
"""Integer depths of this value, the largest of 16 bits, mean "no return", in images of any integer type."""
MIN_FOCAL_LENGTH = 1e-3
"""Minimum focal length [pixels]: smaller values underflow in float32, or are meaningless."""
NEAREST = 0.05
"""Nearer returns are ignored: they come from something that covers the lens [m]."""
FARTHEST = 50.0
"""If half of an image's returns are farther [m], its depths are not in meters, or a large number stands for
"no return"."""
MAX_ANGLE = 0.5
"""Largest angle that `DepthView.pose_deviation` may state [rad]."""
INTRINSICS = ("fx", "fy", "cx", "cy")
DepthImage = Float32[ndarray, "h w"]
"""[m]"""
Pixels = Bool[ndarray, "h w"]
"""Which pixels of an image are meant."""
Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy [pixels]."""
Source = dict[str, str | float]
"""The entry of a view in problem files."""
# Maximum size of the image that is made of a point cloud; sparse clouds get coarser images [pixels].
MAX_CLOUD_WIDTH = 320
MAX_CLOUD_HEIGHT = 240


@no_type_check
@frozen_dataclass
class DepthView(Value):
    """A depth image of a pinhole camera, with the camera's pose in the frame of the robot's base.

    A pixel without a return (less than 0.05, such as 0, or NaN) says nothing: its ray may be free or
    occupied. A pixel of +inf, or above 1e4, means that nothing is within the camera's range (as in ROS, REP
    117).

    Raises:
        InputError: For arrays of the wrong shape, a matrix that is no pose, intrinsics with skew, other names
            or a focal length below MIN_FOCAL_LENGTH, a `range` that is not positive, a negative
            `pose_deviation` or one with an angle above MAX_ANGLE, and a `noise` that is no DepthNoise.
    """

    depth: DepthImage
    """Distance along the optical axis [m]."""
    intrinsics: Intrinsics
    """fx, fy, cx, cy [pixels]; pixel centers have integer coordinates. A mapping from these names to values
    and a camera matrix of 3 x 3 are accepted as well."""
    T_base_camera: Pose
    """Pose of the optical frame of ROS and OpenCV: x to the right in the image, y down, z ahead."""
    configuration: Configuration | None = None
    """Configuration of the arm when the image was taken; None: the problem's start."""
    cloud: Points | None = None
    """The original points [m], if the image was made from a cloud; in the image, each pixel holds only its
    nearest point."""
    source: Source | None = None
    """The image's entry in problem files: a file as `depth`, and its `scale`; or a file as `cloud`."""
    range: float | None = None
    """Largest distance that the sensor measures [m]. If it is given, large regions of 0 or NaN at the border
    of the image mean that nothing is within this distance, unless the image seems to be cropped there. None:
    such a pixel has no meaning."""
    noise: "DepthNoise | None" = None
    """Noise of the sensor, as `measure_noise` returns it; None: estimated from the image."""
    pose_deviation: tuple[float, float] = (0.0, 0.0)
    """Largest error of T_base_camera: position [m] and angle [rad]. If the arm carries the camera, the arm's
    own error is included."""

    def __post_init__(self) -> None:
        depth = numbers(self.depth)
        if depth is None or depth.ndim != 2 or depth.size == 0:
            raise InputError(f"view.depth is {form(depth)}; it must be an image of height x width")
        configuration = self.configuration
        if configuration is not None:
            configuration = vector("view", "configuration", configuration, None)
        deviation = vector("view", "pose_deviation", self.pose_deviation, 2)
        if min(deviation) < 0 or deviation[1] > MAX_ANGLE:
            raise InputError(
                f"view.pose_deviation is {shown(self.pose_deviation)}; it must be a position [m] and an angle"
                f" up to {MAX_ANGLE:g} [rad], both at least 0"
            )
        check_type("view.noise", self.noise, (DepthNoise, type(None)), "what rd.measure_noise returns")
        depth = np.where(depth > MAX_COORDINATE, np.inf, depth).astype(np.float32)
        self.__dict__.update(
            depth=depth,
            intrinsics=checked_intrinsics("view", self.intrinsics),
            T_base_camera=rigid_transform("view.T_base_camera", self.T_base_camera),
            configuration=configuration,
            range=None if self.range is None else positive("view", "range", self.range),
            cloud=None if self.cloud is None else points("view", "cloud", self.cloud),
            pose_deviation=tuple(deviation.tolist()),
        )
        super().__post_init__()

    if TYPE_CHECKING:

        def __init__(
            self,
            depth: ArrayLike,
            intrinsics: ArrayLike | Mapping[str, float],
            T_base_camera: ArrayLike,
            configuration: ArrayLike | None = None,
            cloud: Points | None = None,
            source: Source | None = None,
            range: float | None = None,
            noise: "DepthNoise | None" = None,
            pose_deviation: ArrayLike = (0.0, 0.0),
        ) -> None: ...

    def points(self) -> Points:
        """Compute the points that the camera saw.

        Returns:
            Points [n, 3] in the base frame [m]; the original cloud, or a point for each pixel with a return,
            row by row.
        """
        if self.cloud is not None:
            return self.cloud
        v, u = np.nonzero(np.isfinite(self.depth) & (self.depth >= NEAREST))
        z = self.depth[v, u].astype(np.float64)
        return placed(self.T_base_camera, unprojected(self, u, v, z))

    def moved(self, T: Pose) -> "DepthView":
        """Move the camera and the points.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The view after the motion. If it was made from a cloud, its `source` is None.

        Raises:
            InputError: Unless T is rigid.
        """
        T = rigid_motion(T)
        cloud = None if self.cloud is None else placed(T, self.cloud)
        source = self.source if cloud is None else None
        return replace(self, T_base_camera=T @ self.T_base_camera, cloud=cloud, source=source)

    @classmethod
    def from_cloud(
        cls,
        points: Points,
        T_base_camera: Pose,
        configuration: Configuration | None = None,
        source: Source | None = None,
    ) -> "DepthView":
        """Make the depth image that a camera would take of a point cloud.

        Each pixel holds its nearest point. The image covers the cloud except for outliers, and its pixels are
        large enough that most of them contain points. Points behind the camera are ignored.

        Args:
            points: The cloud [n, 3] in the frame of the base [m].
            T_base_camera: Pose of the optical frame [4, 4]: x right in the image, y down, z ahead.
            configuration: Configuration of the arm when the cloud was recorded, to remove the arm's own
                points; None: the start of the problem.
            source: The file of the cloud, for problem files.

        Returns:
            The view, which keeps the cloud.

        Raises:
            InputError: If no point is in front of the camera, for a T_base_camera that is no pose, for points
                that are not n x 3 finite numbers, and for a configuration that is not a list of numbers.
        """
        T = rigid_transform("view.T_base_camera", T_base_camera)
        points = rows("view.points", points, None, 3)
        in_camera = seen_from(T, points)
        z = in_camera[:, 2]
        in_front = z > 1e-3
        if not in_front.any():
            raise InputError(
                f"view.points: none of {len(points)} is in front of the camera; is T_base_camera (x right, y"
                " down, z ahead) right, and are the points in the base frame?"
            )
        z = z[in_front]
        slopes = in_camera[in_front, :2] / z[:, None]
        low, high = np.percentile(slopes, (0.1, 99.9), axis=0)
        span = np.maximum(high - low, 1e-3)
        pixel = max(np.sqrt(2 * span.prod() / len(z)), span[0] / MAX_CLOUD_WIDTH, span[1] / MAX_CLOUD_HEIGHT)
        at = np.rint((slopes - low) / pixel).astype(np.int64)
        width, height = (np.ceil(span / pixel).astype(np.int64) + 1).tolist()
        inside = ((at >= 0) & (at < (width, height))).all(axis=1)
        depth = np.full(height * width, np.inf)
        np.minimum.at(depth, at[inside, 1] * width + at[inside, 0], z[inside])
        intrinsics = (1 / pixel, 1 / pixel, -low[0] / pixel, -low[1] / pixel)
        image = np.where(np.isfinite(depth), depth, 0.0).reshape(height, width)
        return cls(image, intrinsics, T, configuration, points, source)


def unprojected(view: DepthView, u: ndarray, v: ndarray, z: ndarray) -> Points:
    """The points at pixels u, v and depths z, in the camera's frame [m]."""
    fx, fy, cx, cy = view.intrinsics
    return np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=1)


def checked_intrinsics(owner: str, given: object) -> Intrinsics:
    """fx, fy, cx, cy [pixels] from four numbers, a mapping or a camera matrix, the field `intrinsics` of
    `owner`. Raises InputError for anything else, skew, and focal lengths below MIN_FOCAL_LENGTH."""
    if isinstance(given, Mapping):
        if {*given} != {*INTRINSICS}:
            raise InputError(
                f"{owner}.intrinsics has {shown([*given])}; it must have {', '.join(INTRINSICS)}"
            )
        given = [given[name] for name in INTRINSICS]
    matrix = numbers(given)
    if matrix is not None and matrix.shape == (3, 3):
        fx, skew, cx, _, fy, cy = matrix[:2].ravel()
        if skew != 0 or matrix[1, 0] != 0 or not np.array_equal(matrix[2], (0, 0, 1)):
            raise InputError(
                f"{owner}.intrinsics is {shown(matrix)}; it must be fx 0 cx, 0 fy cy, 0 0 1, without skew"
            )
        given = [fx, fy, cx, cy]
    fx, fy, cx, cy = vector(owner, "intrinsics", given, 4, MAX_RATE).tolist()
    if min(fx, fy) < MIN_FOCAL_LENGTH:
        requirement = f"fx and fy must be at least {MIN_FOCAL_LENGTH:g} [pixels]"
        raise InputError(f"{owner}.intrinsics is {shown([fx, fy, cx, cy])}; {requirement}")
    return fx, fy, cx, cy


class SeenPoints(PointCloud):
    """Points of a problem's scene that its views observed."""


class AssumedPoints(PointCloud):
    """Points of unknown space that an assumption treats as occupied."""


Angle = Annotated[float, Bound(least=0.0, below=np.pi / 2)]


@dataclass(frozen=True)
class DepthNoise(Settings, name="depth_noise"):
    """Noise of a real depth camera; the defaults resemble a stereo camera."""

    spread: Annotated[float, Bound(least=0.0, most=0.1)] = 0.0015
    """Standard deviation of depth at a distance of 1 m [m]; it grows with the square of the distance."""
    missing: ShareBelowOne = 0.0
    """Fraction of all pixels that have no return."""
    stray: ShareBelowOne = 0.01
    """Fraction of the pixels with a return whose depth is somewhere between the camera and the surface."""
    flying: ShareBelowOne = 0.3
    """Fraction of the pixels at edges whose depth is between the two surfaces (flying pixels)."""
    edge_missing: ShareBelowOne = 0.3
    """Fraction of the pixels at edges without a return."""
    edge: Positive = 0.05
    """A pixel whose depth differs from that of the next pixel to the right or below by more than this is at
    an edge [m]."""
    grazing: Angle = 0.17
    """Surfaces at a smaller angle to the line of sight give no return [rad]."""
    correlation: Annotated[float, Bound(least=0.0, most=100.0)] = 0.0
    """Distance at which the correlation of the errors of two pixels has fallen to exp(-1/2) [pixels];
    recorded sensors have 1 to 3."""
    zeros: bool = False
    """Whether pixels without anything in range are 0, as from most sensors, instead of infinite."""

    def applied(self, view: DepthView, rng: Generator) -> DepthView:
        """The view with this noise added to its depths."""
        clean = view.depth
        depth = view.depth.astype(np.float64)
        lost = self._grazed(view)  # pixels that will have no return
        for axis in (0, 1):
            # of two neighbors with an edge between them, only the first may become a flying pixel
            neighbor = clean.take(np.arange(1, clean.shape[axis] + 1), axis, mode="clip")
            both = np.isfinite(clean) & np.isfinite(neighbor)
            step = np.where(both, neighbor, 0.0) - np.where(both, clean, 0.0)
            edge = np.abs(step) > self.edge
            flies = edge & (rng.random(clean.shape) < self.flying)
            depth[flies] = clean[flies] + rng.random(int(flies.sum())) * step[flies]
            lost |= edge & (rng.random(clean.shape) < self.edge_missing)
        seen = np.isfinite(depth) & (depth > 0)
        errors = rng.standard_normal(depth.shape)
        if self.correlation > 0:
            from scipy.ndimage import gaussian_filter

            errors = gaussian_filter(errors, self.correlation / np.sqrt(2), mode="wrap")
            errors /= errors.std() or 1.0  # 0 in an image of one pixel
        depth[seen] += self.spread * depth[seen] ** 2 * errors[seen]
        stray = seen & (rng.random(depth.shape) < self.stray)
        depth[stray] *= rng.random(int(stray.sum()))
        depth[lost | (rng.random(depth.shape) < self.missing)] = 0.0
        if self.zeros:
            depth[np.isinf(depth)] = 0.0
        return replace(view, depth=depth, source=None)

    def _grazed(self, view: DepthView) -> Pixels:
        """Pixels that see their surface at a smaller angle than `grazing`."""
        depth = np.where(np.isfinite(view.depth) & (view.depth > 0), view.depth, np.nan).astype(np.float64)
        steepness = np.zeros_like(depth)
        for axis, focal in ((1, view.intrinsics[0]), (0, view.intrinsics[1])):
            forward = np.diff(depth, axis=axis, append=np.nan)
            backward = np.diff(depth, axis=axis, prepend=np.nan)
            # use the smaller difference: at an edge, the larger one belongs to two surfaces
            steepness += (focal * np.fmin(np.abs(forward), np.abs(backward)) / depth) ** 2
        return np.sqrt(steepness) * np.tan(self.grazing) > 1
