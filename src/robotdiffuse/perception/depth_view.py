"""DepthView: one picture of a depth camera, with where the camera and the arm were when it was taken.

As with shapes, the constructor checks its arguments itself: see `no_type_check` in shapes.py.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, no_type_check

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import MAX_RATE, Value, numbers, rigid_transform, vector
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.scenes.shapes import PointCloud

LEAST_FOCAL = 1e-3
"""Of a lens [pixels]: smaller ones are no numbers above 0 in float32, or say nothing."""
CLOUD_WIDTH, CLOUD_HEIGHT = 320, 240
"""Most pixels of the image that a cloud becomes: coarser where its points are sparse."""


@no_type_check
@dataclass(frozen=True, eq=False)
class DepthView(Value):
    """A depth image of a pinhole camera, in the frame of the robot's base.

    A pixel without a return, 0, negative or not a number, says nothing: neither that space is free nor that
    it is occupied. One that is +inf saw nothing as far as the camera sees (as in ROS, REP 117). Raises
    InputError for arrays of the wrong shape and for poses that are none.
    """

    depth: Float32[ndarray, "h w"]
    """Along the optical axis [m]."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy [pixels]; centres of pixels are at whole coordinates."""
    T_base_camera: Float[ndarray, "4 4"]
    """x to the right in the image, y down, z ahead: the optical frame of ROS and OpenCV."""
    configuration: Float[ndarray, "dof"] | None = None
    """The arm's when the picture was taken; None: the problem's start."""
    cloud: Float[ndarray, "n 3"] | None = None
    """The points themselves [m], where the image was made of a cloud: it holds only the nearest ones."""
    source: dict[str, str | float] | None = None
    """How a problem file names the picture: `depth`, a file, and its `scale`, or `cloud`."""

    def __post_init__(self) -> None:
        depth = numbers(self.depth)
        if depth is None or depth.ndim != 2 or depth.size == 0:
            form = "not numbers" if depth is None else f"an array of {' x '.join(map(str, depth.shape))}"
            raise InputError(f"view.depth is {form}; it must be an image of height x width")
        intrinsics = vector("view", "intrinsics", self.intrinsics, 4, MAX_RATE)
        if min(intrinsics[:2]) < LEAST_FOCAL:
            least = f"fx and fy must be at least {LEAST_FOCAL:g} [pixels]"
            raise InputError(f"view.intrinsics is {shown(intrinsics)}; {least}")
        configuration = self.configuration
        if configuration is not None:
            array = numbers(configuration)
            configuration = vector("view", "configuration", configuration, 1 if array is None else array.size)
        with np.errstate(over="ignore"):  # beyond float32 is as far as +inf
            depth = np.ascontiguousarray(depth, np.float32)
        for key, value in {
            "depth": depth,
            "intrinsics": tuple(intrinsics.tolist()),
            "T_base_camera": rigid_transform("view.T_base_camera", self.T_base_camera),
            "configuration": configuration,
        }.items():
            object.__setattr__(self, key, value)
        super().__post_init__()

    if TYPE_CHECKING:

        def __init__(
            self,
            depth: ArrayLike,
            intrinsics: ArrayLike,
            T_base_camera: ArrayLike,
            configuration: ArrayLike | None = None,
            cloud: Float[ndarray, "n 3"] | None = None,
            source: dict[str, str | float] | None = None,
        ) -> None: ...

    def points(self) -> Float[ndarray, "n 3"]:
        """Those of the cloud, or one for each pixel that returned, row by row."""
        if self.cloud is not None:
            return self.cloud
        rows, columns = np.nonzero(np.isfinite(self.depth) & (self.depth > 0))
        z = self.depth[rows, columns].astype(np.float64)
        fx, fy, cx, cy = self.intrinsics
        in_camera = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=1)
        return in_camera @ self.T_base_camera[:3, :3].T + self.T_base_camera[:3, 3]

    def moved(self, T: Float[ndarray, "4 4"]) -> "DepthView":
        """The view with camera and points after a rigid motion."""
        cloud = None if self.cloud is None else self.cloud @ T[:3, :3].T + T[:3, 3]
        return replace(self, T_base_camera=T @ self.T_base_camera, cloud=cloud)

    @classmethod
    def from_cloud(
        cls,
        points: Float[ndarray, "n 3"],
        T_base_camera: Float[ndarray, "4 4"],
        configuration: Float[ndarray, "dof"] | None = None,
        source: dict[str, str | float] | None = None,
    ) -> "DepthView":
        """The image that a camera has of a cloud in the base frame: each pixel its nearest point.

        The image is as wide as the cloud is seen, and its pixels so wide that most of them hold points.
        Points behind the camera, which it cannot have seen, are left out. Raises InputError if no point is
        ahead of the camera.
        """
        T = cls(np.zeros((1, 1)), (1.0, 1.0, 0.0, 0.0), T_base_camera, configuration).T_base_camera
        in_camera = (points - T[:3, 3]) @ T[:3, :3]
        z = in_camera[:, 2]
        ahead = z > 1e-3
        if not ahead.any():
            raise InputError(
                f"view.points: none of {len(points)} lies ahead of the camera; is T_base_camera (x right, y"
                " down, z ahead) right, and are the points in the base frame?"
            )
        z = z[ahead]
        slopes = in_camera[ahead, :2] / z[:, None]
        low, high = np.percentile(slopes, (0.1, 99.9), axis=0)
        span = np.maximum(high - low, 1e-3)
        pixel = max(np.sqrt(2 * span.prod() / len(z)), span[0] / CLOUD_WIDTH, span[1] / CLOUD_HEIGHT)
        at = np.rint((slopes - low) / pixel).astype(np.int64)
        width, height = (np.ceil(span / pixel).astype(np.int64) + 1).tolist()
        inside = ((at >= 0) & (at < (width, height))).all(axis=1)
        depth = np.full(height * width, np.inf)
        np.minimum.at(depth, at[inside, 1] * width + at[inside, 0], z[inside])
        intrinsics = (1 / pixel, 1 / pixel, -low[0] / pixel, -low[1] / pixel)
        image = np.where(np.isfinite(depth), depth, 0.0).reshape(height, width)
        return cls(image, intrinsics, T, configuration, points, source)


class SeenPoints(PointCloud):
    """What a problem has of its views, beside the shapes that it was given."""


class AssumedPoints(PointCloud):
    """What is taken for occupied beside what was seen."""
