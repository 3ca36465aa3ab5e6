"""Renders depth images of scenes in milliseconds."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import transform
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.ray_kernel import BOX, CAPSULE, CYLINDER, SPHERE, render_depth
from robotdiffuse.perception.voxel_kernel import fill_voxels
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Shape, Sphere

MAX_RANGE = 4.0
"""Range of the cameras [m]."""


def looking_at(
    position: Float[ndarray, "3"], target: Float[ndarray, "3"], roll: float = 0.0
) -> Float[ndarray, "4 4"]:
    """T_base_camera of a camera at `position` that looks at `target`, upright except for `roll` [rad].

    x is to the right in the image, y down, z forward. If the camera looks straight down, the top of the image
    is towards +x.
    """
    z = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.array([z[1], -z[0], 0.0])
    x = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([0.0, -1.0, 0.0])
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    return transform(np.asarray(position, np.float64), np.stack([c * x + s * y, c * y - s * x, z], axis=1))


def ray_cast(
    scene: Scene,
    T_base_camera: Float[ndarray, "4 4"],
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
    robot: Robot | None = None,
    configuration: Float[ndarray, "dof"] | None = None,
) -> DepthView:
    """The depth image of a scene, and of the covering spheres of a robot if one is given.

    size: width and height [pixels]; intrinsics: see DepthView. Depth is infinite for pixels without an
    obstacle within MAX_RANGE. Raises InputError for shapes other than spheres, boxes, cylinders and capsules.
    """
    kinds, rows = _rows(scene)
    if robot is not None and configuration is not None:
        spheres = [_sphere_row(sphere) for sphere in placed_spheres(robot, configuration)]
        kinds = np.append(kinds, np.full(len(spheres), SPHERE))
        rows = np.concatenate([rows, np.array(spheres, np.float32).reshape(-1, 16)])
    depth = np.full((size[1], size[0]), MAX_RANGE, np.float32)
    render_depth(kinds, rows, np.array(intrinsics, np.float32), np.asarray(T_base_camera, np.float32), depth)
    depth[depth >= MAX_RANGE] = np.inf
    return DepthView(depth, intrinsics, T_base_camera, configuration)


def voxels_within(
    scene: Scene,
    low: tuple[float, float, float],
    voxel: float,
    shape: tuple[int, int, int],
    margin: float = 0.005,
) -> Bool[ndarray, "nx ny nz"]:
    """Which voxels of a grid are occupied: their centre is in a shape, or at most `margin` [m] from it.

    With the default margin, walls of 1 cm have no holes in a grid with voxels of 2 cm. Raises
    InputError for shapes other than spheres, boxes, cylinders and capsules.
    """
    out = np.zeros(shape, np.bool_)
    fill_voxels(*_rows(scene), np.array(low, np.float32), np.float32(voxel), np.float32(margin), out)
    return out


def _rows(scene: Scene) -> tuple[Int64[ndarray, "n"], Float32[ndarray, "n 16"]]:
    """Kinds and parameter rows of the shapes for the Numba kernels."""
    kinds = np.array([_kind(shape) for shape in scene.shapes], np.int64)
    return kinds, np.array([_row(shape) for shape in scene.shapes], np.float32).reshape(-1, 16)


def _kind(shape: Shape) -> int:
    kind = {Sphere: SPHERE, Box: BOX, Cylinder: CYLINDER, Capsule: CAPSULE}.get(type(shape))
    if kind is None:
        raise InputError(
            f"{shape.name} is a {shape.kind}; only spheres, boxes, cylinders and capsules can be rendered"
        )
    return kind


def _row(shape: Shape) -> ndarray:
    if isinstance(shape, Sphere):
        return _sphere_row(np.append(shape.center, shape.radius))
    assert isinstance(shape, Box | Cylinder | Capsule)  # by _kind
    if isinstance(shape, Box):
        half, around = shape.size / 2, float(np.linalg.norm(shape.size)) / 2
    else:
        half = np.array([shape.radius, shape.height / 2, 0.0])
        around = float(np.hypot(*half[:2]) if isinstance(shape, Cylinder) else half[:2].sum())
    return np.concatenate([shape.center, shape.rotation.T.ravel(), half, [around]])


def _sphere_row(sphere: Float[ndarray, "4"]) -> ndarray:
    return np.concatenate([sphere[:3], np.eye(3).ravel(), [sphere[3], 0.0, 0.0, sphere[3]]])
