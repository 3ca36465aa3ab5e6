"""Simulated depth cameras: depth images and point clouds of a PyBullet world."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pybullet
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.scenes.point_cloud import voxel_thin
from robotdiffuse.scenes.shapes import PointCloud
from robotdiffuse.simulation.world import World

SAMPLE_OFFSET = (0.0, 1.0)
"""Position within a pixel, in columns and rows from its upper left corner, that PyBullet's renderer samples.

Measured by rendering a sphere: its points then lie on it within 0.1 mm; half a pixel off, within 2 mm.
"""


@dataclass(frozen=True)
class DepthCamera:
    """A pinhole camera with the noise of a depth sensor, in the base frame of the robot."""

    position: tuple[float, float, float]
    """[m]"""
    target: tuple[float, float, float]
    """The point at the centre of the image [m]."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Upward direction in the image; not along the line of sight."""
    width: int = 320
    """[pixels]"""
    height: int = 240
    """[pixels]"""
    field_of_view: float = 0.96
    """Vertical angle [rad]; the default is about that of common stereo depth cameras."""
    near: float = 0.1
    """Near clipping distance [m]."""
    far: float = 4.0
    """Far clipping distance [m]."""
    noise: float = 0.0
    """Standard deviation of the distance along the ray [m]."""
    dropout: float = 0.0
    """Fraction of pixels without a measurement, in [0, 1)."""

    def __post_init__(self) -> None:
        for name in ("position", "target", "up"):
            value = getattr(self, name)
            if len(value) != 3 or not np.isfinite(value).all():
                raise InputError(f"camera.{name} is {value}; it must be 3 finite numbers")
        sight = np.subtract(self.target, self.position)
        if np.linalg.norm(np.cross(sight, self.up)) < 1e-6 * np.linalg.norm(sight) or not sight.any():
            raise InputError(
                f"camera.up is {self.up}; it must not lie along the line of sight {tuple(sight.tolist())}"
            )
        if not (1 <= self.width <= 4096 and 1 <= self.height <= 4096):
            raise InputError(f"camera is {self.width} x {self.height} pixels; each must lie in [1, 4096]")
        if not 0 < self.field_of_view < np.pi:
            raise InputError(f"camera.field_of_view is {self.field_of_view}; it must lie in (0, pi) rad")
        if not 0 < self.near < self.far < np.inf:
            raise InputError(f"camera.near is {self.near} and far {self.far}; it must be 0 < near < far")
        if not self.noise >= 0:
            raise InputError(f"camera.noise is {self.noise}; it must not be negative [m]")
        if not 0 <= self.dropout < 1:
            raise InputError(f"camera.dropout is {self.dropout}; it must lie in [0, 1)")

    @property
    def rotation(self) -> Float[ndarray, "3 3"]:
        """Unit vectors to the right, upwards and forwards in the base frame, as columns."""
        forward = np.subtract(self.target, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward], axis=1)

    def rays(self) -> Float[ndarray, "height width 3"]:
        """Vectors from the camera through each pixel, in the base frame, 1 m long along the optical axis."""
        slope = np.tan(self.field_of_view / 2)
        x = (
            (2 * (np.arange(self.width) + SAMPLE_OFFSET[0]) / self.width - 1)
            * slope
            * self.width
            / self.height
        )
        y = (1 - 2 * (np.arange(self.height) + SAMPLE_OFFSET[1]) / self.height) * slope
        return np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=-1) @ self.rotation.T


class RawImage(NamedTuple):
    """An image of PyBullet's renderer."""

    rgb: UInt8[ndarray, "height width 3"]
    depth: Float[ndarray, "height width"]
    """Along the optical axis [m]; infinite where nothing is visible."""
    bodies: Int[ndarray, "height width"]
    """PyBullet's body index; -1 where nothing is visible."""


class Light(NamedTuple):
    """Lighting of an image."""

    direction: tuple[float, float, float] = (0.6, -0.8, 1.4)
    """Direction towards the light."""
    ambient: float = 0.6
    diffuse: float = 0.35
    specular: float = 0.05


DAYLIGHT = Light()


def capture(world: World, camera: DepthCamera, light: Light = DAYLIGHT) -> RawImage:
    """Render one image with PyBullet's software renderer, without noise.

    Raises InputError for a world that was made without visuals.
    """
    if not world.visuals:
        raise InputError("this world has no visuals for cameras; create it with World(..., visuals=True)")
    view = pybullet.computeViewMatrix(camera.position, camera.target, camera.up)
    near, far = camera.near, camera.far
    projection = pybullet.computeProjectionMatrixFOV(
        np.degrees(camera.field_of_view), camera.width / camera.height, near, far
    )
    _, _, rgba, buffer, bodies = pybullet.getCameraImage(
        camera.width,
        camera.height,
        view,
        projection,
        lightDirection=light.direction,
        shadow=0,
        lightAmbientCoeff=light.ambient,
        lightDiffuseCoeff=light.diffuse,
        lightSpecularCoeff=light.specular,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=world.client,
    )
    shape = (camera.height, camera.width)
    bodies = np.asarray(bodies, np.int64).reshape(shape)
    buffer = np.asarray(buffer, np.float64).reshape(shape)
    depth = np.where(bodies >= 0, far * near / (far - (far - near) * buffer), np.inf)
    return RawImage(np.asarray(rgba, np.uint8).reshape(*shape, 4)[..., :3], depth, bodies)


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A depth image without noise."""

    depth: Float[ndarray, "height width"]
    """Along the optical axis [m]; infinite where nothing is visible."""
    labels: Int[ndarray, "height width"]
    """Index into `names`; -1 where nothing is visible."""
    names: tuple[str, ...]
    """Name of the robot, then of the obstacles."""


def render(world: World, camera: DepthCamera) -> DepthImage:
    """The depth image and the label of each pixel. The world must have visuals."""
    _, depth, bodies = capture(world, camera)
    labels = np.full(bodies.shape, -1)
    for label, body in enumerate((world.body, *world.obstacles.values())):
        labels[bodies == body] = label
    return DepthImage(depth, labels, (world.robot.name, *world.obstacles))


def point_cloud(
    world: World,
    cameras: Sequence[DepthCamera],
    rng: np.random.Generator,
    voxel: float = 0.01,
    point_radius: float = 0.01,
    without: Sequence[str] = (),
) -> PointCloud:
    """A point cloud of the obstacles as the cameras see them, in the base frame, to plan with.

    The arm stays in its last configuration. Its pixels and those of the obstacles in `without` (such as the
    floor) are removed, but they still hide what is behind them. Each ray gets the noise and dropout of its
    camera; then one point is kept per voxel of edge length `voxel` [m]. `point_radius` [m] becomes that of
    the cloud.

    The world must have visuals. Raises InputError for a name in `without` that is not an obstacle.
    """
    for name in without:
        if name not in world.obstacles:
            raise unknown_name("obstacle in without:", name, world.obstacles)
    kept = [body for name, body in world.obstacles.items() if name not in without]
    clouds = [np.zeros((0, 3))]
    for camera in cameras:
        _, depth, bodies = capture(world, camera)
        seen = np.isin(bodies, kept) & (rng.random(bodies.shape) >= camera.dropout)
        rays = camera.rays()[seen]
        lengths = np.linalg.norm(rays, axis=1)
        distances = depth[seen] * lengths + camera.noise * rng.standard_normal(len(rays))
        clouds.append(np.array(camera.position) + rays * (distances / lengths)[:, None])
    return PointCloud(voxel_thin(np.concatenate(clouds), voxel), point_radius)
