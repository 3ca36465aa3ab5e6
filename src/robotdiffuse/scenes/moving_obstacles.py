"""Moving obstacles: with a known trajectory, or with an unknown motion of limited speed.

As with shapes, the constructor checks its arguments itself; scenes/shapes.py explains `no_type_check`.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import (
    InputError,
    distinct,
    form,
    located,
    numbers,
    rigid_motion,
    rigid_transform,
    shown,
    vector,
    within,
)
from robotdiffuse.core.transforms import (
    inverse,
    quaternion_from_rotation,
    rotation_angle,
    rotation_from_quaternion,
    transform,
)
from robotdiffuse.core.types import (
    ArrayOrNone,
    Pose,
    Poses,
    Value,
    Values,
    VectorOrNone,
    check_increasing,
    frozen_dataclass,
    no_type_check,
    read_only,
)
from robotdiffuse.scenes.shapes import Shape

MAX_POINT_SPEED = 100.0
"""Largest allowed speed of a point of an obstacle [m/s]; a faster motion between two poses counts as a
jump."""
MAX_DURATION = 1e5
"""Duration for which a constant velocity lasts, and largest absolute value of `times` [s]: about a day. The
validator refuses longer motions."""
RIGID_SLACK = 1e-6
"""Largest deviation of a pose from a rigid transform."""
POSE_TOLERANCE = 1e-6
"""Largest difference between the first pose and the pose of the shape [m], [rad]."""


@no_type_check
@frozen_dataclass
class MovingObstacle(Value):
    """A shape in the frame of the robot's base, and one of three motions.

    Args:
        shape: The shape at time 0, or at the first of the times; not a point cloud, which has no frame of its
            own.
        velocity: The shape keeps its orientation and moves at this constant velocity forever [m/s].
        times: Times of the poses [n], increasing [s].
        poses: T_base_shape at each time [n, 4, 4]; the first is the pose of the shape. Between the times, the
            shape moves on straight lines at constant speed and turns at a constant rate. Before the first and
            after the last time it stands still.
        max_speed: The motion is unknown, but no point of the shape is faster than this [m/s].

    Raises:
        InputError: Unless exactly one motion is given: velocity, times and poses, or max_speed; for wrong
            values; and for poses that jump, so that a point may be faster than 100 m/s.
    """

    shape: Shape
    velocity: VectorOrNone = None  # pyright: ignore[reportAssignmentType]
    times: ArrayOrNone = None  # pyright: ignore[reportAssignmentType]
    poses: ArrayOrNone = None  # pyright: ignore[reportAssignmentType]
    max_speed: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.shape, Shape):
            raise InputError(f"moving: shape is {shown(self.shape)}; it must be a shape, e.g. rd.Sphere")
        _ = self.shape.T_base_shape  # raises InputError for shapes that have no frame
        motions = {
            "velocity": self.velocity is not None,
            "times and poses": self.times is not None or self.poses is not None,
            "max_speed": self.max_speed is not None,
        }
        motions_set = [name for name, has in motions.items() if has]
        if len(motions_set) != 1:
            raise InputError(
                f"moving obstacle {self.name!r} has {' and '.join(motions_set) or 'no motion'}; it must have "
                "exactly one of velocity, times and poses, max_speed"
            )
        if self.velocity is not None:
            object.__setattr__(
                self, "velocity", vector(self.name, "velocity", self.velocity, 3, MAX_POINT_SPEED)
            )
        elif self.max_speed is not None:
            speed = numbers(self.max_speed)
            if speed is None or speed.ndim != 0 or not 0 <= speed <= MAX_POINT_SPEED:
                raise InputError(
                    f"{self.name}.max_speed is {shown(self.max_speed)}; it must be a speed from 0 to "
                    f"{MAX_POINT_SPEED:g} m/s"
                )
            object.__setattr__(self, "max_speed", float(speed))
        else:
            self._check_track()
        super().__post_init__()

    def _check_track(self) -> None:
        """Sets `times` and `poses` to arrays. Raises InputError unless times increase, all poses are rigid
        transforms, the first is the pose of the shape, and there are no jumps."""
        times = numbers(self.times)
        poses = numbers(self.poses)
        if times is None or times.ndim != 1 or len(times) < 2 or not within(times, MAX_DURATION):
            raise InputError(
                f"{self.name}.times is {shown(self.times)}; it must be two or more times within "
                f"±{MAX_DURATION:g} s, one for each of the poses"
            )
        with located(self.name):
            check_increasing(times)
        if poses is None or poses.shape != (len(times), 4, 4):
            raise InputError(
                f"{self.name}.poses is {form(poses)}; it must be {len(times)} transforms of 4 x 4, one for "
                f"each time"
            )
        for i, T in enumerate(poses):
            rigid_transform(f"{self.name}.poses[{i}]", T, RIGID_SLACK)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "poses", poses)
        T_shape_first = inverse(self.shape.T_base_shape) @ poses[0]
        if (
            np.linalg.norm(T_shape_first[:3, 3]) > POSE_TOLERANCE
            or rotation_angle(T_shape_first[:3, :3]) > POSE_TOLERANCE
        ):
            raise InputError(
                f"{self.name}.poses[0] is at {shown(poses[0, :3, 3])}; it must be the pose of the shape, "
                f"whose position is {shown(self.shape.T_base_shape[:3, 3])}"
            )
        speeds = track_speeds(times, poses, self.radius)
        jumps = np.flatnonzero(speeds > MAX_POINT_SPEED)
        if len(jumps):
            i = int(jumps[0])
            begins, ends = distinct(times[i], times[i + 1])
            speed, limit = distinct(speeds[i], MAX_POINT_SPEED, digits=3)
            raise InputError(
                f"{self.name}.poses[{i + 1}] is a jump: from {begins} s to {ends} s a point moves at {speed} "
                f"m/s; the limit is {limit} m/s"
            )

    @property
    def name(self) -> str:
        return self.shape.name

    @property
    def known(self) -> bool:
        """Whether the obstacle's motion is known."""
        return self.max_speed is None

    @cached_property
    def radius(self) -> float:
        """Upper bound on the distance of the shape's points from the origin of its frame [m]."""
        low, high = self.shape.bounds
        center = self.shape.T_base_shape[:3, 3]
        return float(np.linalg.norm(np.maximum(np.abs(low - center), np.abs(high - center))))

    @cached_property
    def track(self) -> tuple[Values, Poses]:
        """Times [s], and the poses T_base_shape at these times. Between them, the obstacle moves at constant
        rates; before the first and after the last it stands still.

        If the motion is unknown, the track is the pose at time 0 only.
        """
        T = self.shape.T_base_shape
        if self.velocity is not None:
            poses = np.stack([T, transform(self.velocity * MAX_DURATION) @ T])
            return read_only((np.array([0.0, MAX_DURATION]), poses))
        if self.times is not None and self.poses is not None:
            return self.times, self.poses
        return read_only((np.zeros(1), T[None]))

    @property
    def top_speed(self) -> float:
        """Speed that no point of the obstacle exceeds at any time [m/s]."""
        if self.max_speed is not None:
            return self.max_speed
        return float(track_speeds(*self.track, self.radius).max(initial=0.0))

    def pose(self, time: float) -> Pose:
        """T_base_shape at a time.

        Args:
            time: Time since the motion begins [s].

        Returns:
            The pose [4, 4]; if the motion is unknown, the pose at time 0.

        Raises:
            InputError: For a time that is not a finite number.
        """
        at = numbers(time)
        if at is None or at.ndim or not np.isfinite(at):
            raise InputError(f"time is {shown(time)}; it must be a finite number [s]")
        times, poses = self.track
        if len(times) == 1:
            return poses[0]
        i = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
        fraction = float(np.clip((time - times[i]) / (times[i + 1] - times[i]), 0.0, 1.0))
        xyz = poses[i, :3, 3] + fraction * (poses[i + 1, :3, 3] - poses[i, :3, 3])
        if np.array_equal(poses[i, :3, :3], poses[i + 1, :3, :3]):
            return transform(xyz, poses[i, :3, :3])
        a, b = (quaternion_from_rotation(poses[k, :3, :3]) for k in (i, i + 1))
        return transform(xyz, rotation_from_quaternion(_slerp(a, b, fraction)))

    def at(self, time: float) -> Shape:
        """Place the shape at its pose at a time.

        Args:
            time: Time since the motion begins [s].

        Returns:
            The shape; if the motion is unknown, at its pose at time 0.

        Raises:
            InputError: For a time that is not a finite number.
        """
        return self.shape.moved(self.pose(time) @ inverse(self.shape.T_base_shape))

    def moved(self, T: Pose) -> "MovingObstacle":
        """Move the obstacle together with its own motion.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The obstacle after the rigid motion.

        Raises:
            InputError: Unless T is rigid.
        """
        T = rigid_motion(T)
        velocity = None if self.velocity is None else T[:3, :3] @ self.velocity
        poses = None if self.poses is None else T @ self.poses
        return replace(self, shape=self.shape.moved(T), velocity=velocity, poses=poses)


def track_speeds(times: Values, poses: Poses, radius: float) -> Float[ndarray, "intervals"]:
    """Upper bounds on the speed between successive times [m/s], for points within `radius` [m] of the origin
    of the moving frame."""
    distances_between = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = [rotation_angle(a.T @ b) for a, b in zip(poses[:-1, :3, :3], poses[1:, :3, :3], strict=True)]
    return (distances_between + radius * np.array(turns)) / np.diff(times)


def _slerp(a: Float[ndarray, "4"], b: Float[ndarray, "4"], fraction: float) -> Float[ndarray, "4"]:
    """The unit quaternion at a fraction of the shorter rotation from a to b."""
    b = b if a @ b >= 0 else -b
    angle = 2 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))
    if angle < 1e-9:
        return b
    return (np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b) / np.sin(angle)
