"""Where shapes stand, and shapes moved to elsewhere."""

from dataclasses import replace
from typing import TypeVar

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_from_quaternion, transform
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, PointCloud, Shape, Sphere, pose

Any = TypeVar("Any", bound=Shape)


def moved(shape: Any, T: Float[ndarray, "4 4"]) -> Any:
    """The shape after a rigid motion. A cloud of points forgets the file that it was read from."""
    match shape:
        case Sphere():
            return replace(shape, center=T[:3, :3] @ shape.center + T[:3, 3])
        case Box() | Cylinder() | Capsule():
            at = T @ pose(shape)
            return replace(shape, center=at[:3, 3], wxyz=quaternion_from_rotation(at[:3, :3]))
        case Mesh():
            at = T @ placed(shape)
            return replace(shape, xyz=at[:3, 3], wxyz=quaternion_from_rotation(at[:3, :3]))
        case PointCloud():
            return replace(shape, points=shape.points @ T[:3, :3].T + T[:3, 3], file=None)
        case _:
            raise InputError(f"a {shape.kind} cannot be moved; write it as a mesh")


def placed(shape: Shape) -> Float[ndarray, "4 4"]:
    """Where a shape stands; InputError for a cloud of points, which has no frame of its own."""
    match shape:
        case Sphere():
            return transform(shape.center)
        case Box() | Cylinder() | Capsule():
            return pose(shape)
        case Mesh():
            return transform(shape.xyz, rotation_from_quaternion(shape.wxyz))
        case _:
            raise InputError(
                f"{shape.name!r} is a {shape.kind}; it must be one of sphere, box, cylinder, capsule and mesh"
            )
