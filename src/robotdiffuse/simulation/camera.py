"""Depth cameras in the PyBullet world: what a sensor sees of a scene, as a point cloud to plan on."""

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

PIXEL = (0.0, 1.0)
"""Where in a pixel, in columns and rows from its upper left corner, PyBullet's renderer takes its sample.

Found by rendering a sphere: its points then lie on it within 0.1 mm; half a pixel off, within 2 mm.
"""


@dataclass(frozen=True)
class DepthCamera:
    """A pinhole camera with the noise of a depth sensor, in the base frame of the robot."""

    position: tuple[float, float, float]
    """[m]"""
    target: tuple[float, float, float]
    """The point in the middle of the image [m]."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """What points upwards in the image; not along the line of sight."""
    width: int = 320
    """[pixels]"""
    height: int = 240
    """[pixels]"""
    field_of_view: float = 0.96
    """Vertical angle [rad]; the default is about that of common stereo depth cameras."""
    near: float = 0.1
    """Nothing nearer than this is seen [m]."""
    far: float = 4.0
    """Nothing farther than this is seen [m]."""
    noise: float = 0.0
    """Standard deviation of the distance along the ray [m]."""
    dropout: float = 0.0
    """Share of pixels that return nothing, in [0, 1)."""

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
        """From the camera to each pixel, in the base frame, one metre forwards."""
        slope = np.tan(self.field_of_view / 2)
        x = (2 * (np.arange(self.width) + PIXEL[0]) / self.width - 1) * slope * self.width / self.height
        y = (1 - 2 * (np.arange(self.height) + PIXEL[1]) / self.height) * slope
        return np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=-1) @ self.rotation.T


class RawImage(NamedTuple):
    """What PyBullet's renderer returns."""

    rgb: UInt8[ndarray, "height width 3"]
    depth: Float[ndarray, "height width"]
    """Along the optical axis [m]; infinite where there is nothing."""
    bodies: Int[ndarray, "height width"]
    """PyBullet's number of the body; -1: nothing."""


class Light(NamedTuple):
    """How a picture is lit."""

    direction: tuple[float, float, float] = (0.6, -0.8, 1.4)
    """Towards the light."""
    ambient: float = 0.6
    diffuse: float = 0.35
    specular: float = 0.05


DAYLIGHT = Light()


def take(world: World, camera: DepthCamera, light: Light = DAYLIGHT) -> RawImage:
    """One picture by PyBullet's software renderer, without noise.

    Raises InputError for a world that was made without surfaces to see.
    """
    if not world.look:
        raise InputError("this world has nothing that a camera could see; make it by World(..., look=True)")
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
    """What a camera sees, without noise."""

    depth: Float[ndarray, "height width"]
    """Along the optical axis [m]; infinite where nothing is seen."""
    labels: Int[ndarray, "height width"]
    """Index into `names`; -1 where nothing is seen."""
    names: tuple[str, ...]
    """The robot's name, then those of the obstacles."""


def render(world: World, camera: DepthCamera) -> DepthImage:
    """The depth image and what is where in it. The world must have been made with `look`."""
    _, depth, bodies = take(world, camera)
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
    """What the cameras see of the obstacles, in the base frame, as one shape to plan with.

    The arm stands as last placed; its pixels and those of the obstacles in `without` (the floor, perhaps) are
    taken out, but they hide what is behind them. Each ray gets its camera's noise and dropout, then one point
    is kept in each cell of a grid `voxel` wide [m]. `point_radius` [m] is that of the shape.

    The world must have been made with `look`. Raises InputError for a name in `without` that is no obstacle.
    """
    for name in without:
        if name not in world.obstacles:
            raise unknown_name("obstacle in without:", name, world.obstacles)
    kept = [body for name, body in world.obstacles.items() if name not in without]
    clouds = [np.zeros((0, 3))]
    for camera in cameras:
        _, depth, bodies = take(world, camera)
        seen = np.isin(bodies, kept) & (rng.random(bodies.shape) >= camera.dropout)
        rays = camera.rays()[seen]
        lengths = np.linalg.norm(rays, axis=1)
        distances = depth[seen] * lengths + camera.noise * rng.standard_normal(len(rays))
        clouds.append(np.array(camera.position) + rays * (distances / lengths)[:, None])
    return PointCloud(voxel_thin(np.concatenate(clouds), voxel), point_radius)
