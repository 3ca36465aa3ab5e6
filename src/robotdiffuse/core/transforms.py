"""Rigid transforms as 4 x 4 matrices and quaternions in wxyz order (NumPy, float64)."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.errors import MAX_RPY, InputError, unit_quaternion, vector
from robotdiffuse.core.types import Points, Pose, Quaternion, Rotation, Spheres, Vector

IDENTITY = np.eye(4)


def rotation_from_quaternion(wxyz: Float[ndarray, "*b 4"]) -> Float[ndarray, "*b 3 3"]:
    """Rotation matrix of a quaternion, which is normalized first."""
    if wxyz.ndim == 1:  # Python floats: for four numbers, NumPy takes several times as long
        w, x, y, z = wxyz.tolist()
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        return np.array(_rotation(w / norm, x / norm, y / norm, z / norm))
    unit = wxyz / np.linalg.norm(wxyz, axis=-1, keepdims=True)
    rows = np.array(_rotation(*np.moveaxis(unit, -1, 0)))
    return np.ascontiguousarray(np.moveaxis(rows, (0, 1), (-2, -1)))


def _rotation(w: Any, x: Any, y: Any, z: Any) -> list[list[Any]]:
    """The rotation matrix of a unit quaternion as rows of entries; its components may be arrays."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def quaternion_from_rotation(rotation: Rotation | Pose) -> Quaternion:
    """Unit quaternion wxyz with w >= 0 of a rotation matrix, or of the rotation of a pose (Bar-Itzhack's
    eigenvector method)."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    wxyz = np.array([w, x, y, z])
    return wxyz if w >= 0 else -wxyz


def xyzw_of(T: Pose) -> Float[ndarray, "4"]:
    """The rotation of a pose as a unit quaternion in the order x, y, z, w."""
    return np.roll(quaternion_from_rotation(T), -1)


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Rotation:
    """URDF's fixed-axis roll, pitch, yaw: Rz(yaw) Ry(pitch) Rx(roll)."""
    (sr, cr), (sp, cp), (sy, cy) = [(np.sin(a), np.cos(a)) for a in (roll, pitch, yaw)]
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_rotation(rotation: Rotation) -> tuple[float, float, float]:
    """URDF's roll, pitch, yaw [rad] of a rotation matrix, with pitch in [-pi/2, pi/2]; roll is 0 in gimbal
    lock."""
    cosine = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], cosine)
    if cosine < 1e-9:
        return 0.0, float(pitch), float(np.arctan2(-rotation[0, 1], rotation[1, 1]))
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return float(roll), float(pitch), float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def rotation_about(axis: Vector, angle: Any) -> Float[ndarray, "*n 3 3"]:
    """Rotation by an angle [rad], or by angles [*n, 1, 1], about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def rotation_z_to(axis: Vector) -> Rotation:
    """A rotation R with R @ [0, 0, 1] = axis (a unit vector); the identity for +z."""
    z = np.array([0.0, 0.0, 1.0])
    sine = np.linalg.norm(np.cross(z, axis))
    cosine = float(axis[2])
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return rotation_about(np.cross(z, axis) / sine, float(np.arctan2(sine, cosine)))


def transform(xyz: Vector, rotation: Rotation | None = None) -> Pose:
    """The 4 x 4 matrix of a rotation (default none) followed by a translation [m]."""
    T = IDENTITY.copy()
    T[:3, 3] = xyz
    if rotation is not None:
        T[:3, :3] = rotation
    return T


def pose(xyz: ArrayLike, *, wxyz: ArrayLike | None = None, rpy: ArrayLike | None = None) -> Pose:
    """A rigid transform from a position and a rotation, as goals, bases, tools and cameras take it.

    Args:
        xyz: Position [m].
        wxyz: Rotation as a quaternion, scalar first, of any length.
        rpy: Rotation as roll, pitch and yaw in the order of URDFs [rad]. Without wxyz and rpy, the rotation
            is the identity.

    Returns:
        The homogeneous transform [4, 4].

    Raises:
        InputError: If both wxyz and rpy are given, for a zero quaternion, for too many or too few values, and
            for values that are no numbers within ±1e4 (rpy: ±6.3, about a turn).

    Examples:
        >>> rd.pose([0.5, 0, 0.3], rpy=[0, 0, np.pi / 2])[0].round(3).tolist()
        [0.0, -1.0, 0.0, 0.5]
    """
    if wxyz is not None and rpy is not None:
        raise InputError("pose has wxyz and rpy; give one of them")
    rotation = None
    if wxyz is not None:
        rotation = rotation_from_quaternion(unit_quaternion("pose", wxyz))
    if rpy is not None:
        rotation = rotation_from_rpy(*vector("pose", "rpy [rad]", rpy, 3, MAX_RPY))
    return transform(vector("pose", "xyz", xyz, 3), rotation)


def pose_entry(T: Pose) -> dict[str, list[float]]:
    """The pose as files hold it: `xyz` [m] and `wxyz`."""
    return {"xyz": T[:3, 3].tolist(), "wxyz": quaternion_from_rotation(T).tolist()}


def inverse(T: Pose) -> Pose:
    """Inverse of a rigid transform."""
    return transform(-T[:3, :3].T @ T[:3, 3], T[:3, :3].T)


def placed(T: Pose, points: Points) -> Points:
    """Points p_b of a frame b in frame a: T_a_b @ p_b, where T is the pose T_a_b."""
    return points @ T[:3, :3].T + T[:3, 3]


def seen_from(T: Pose, points: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """Points p_a of frame a in a frame b: the inverse of `placed`, where T is the pose T_a_b."""
    return (points - T[:3, 3]) @ T[:3, :3]


def placed_each(T: Float[ndarray, "n 4 4"], points: Points) -> Float[ndarray, "n 3"]:
    """`placed` for each point by its own pose."""
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]


def moved_spheres(T: Pose, spheres: Spheres) -> Spheres:
    """Spheres (x y z radius) of a frame b in frame a, where T is the pose T_a_b."""
    return np.column_stack([placed(T, spheres[:, :3]), spheres[:, 3]])


def box_around(points: Points) -> Float[ndarray, "2 3"]:
    """Lower and upper corner of the axis-aligned box around the points."""
    return np.stack([points.min(axis=0), points.max(axis=0)])


def ball_around(points: Points) -> tuple[Vector, float]:
    """Center and radius [m] of a ball around the points; its center is the center of their bounding box."""
    low, high = box_around(points)
    center = (low + high) / 2
    return center, float(np.linalg.norm(points - center, axis=1).max())


def scaled_normals(triangles: Float[ndarray, "n 3 3"]) -> Points:
    """For each triangle, a normal whose length is twice the triangle's area."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return np.cross(b - a, c - a)


def rotation_angle(rotation: Rotation) -> float:
    """Angle [rad] of a rotation matrix, accurate near 0 and pi."""
    skew = rotation - rotation.T
    sine2 = np.sqrt(skew[0, 1] ** 2 + skew[0, 2] ** 2 + skew[1, 2] ** 2)
    return float(np.arctan2(sine2, np.trace(rotation) - 1))
