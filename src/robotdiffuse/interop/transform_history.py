"""Transforms between frames over time, as ROS publishes them on /tf and /tf_static."""

from bisect import bisect_left, insort
from collections.abc import Mapping
from operator import itemgetter
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation, Slerp

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import rotation_from_quaternion, transform
from robotdiffuse.interop.ros_types import header_seconds

_stamp = itemgetter(0)
Stamped = TypeVar("Stamped", bound=tuple[float, Any])


def insert_by_time(history: list[Stamped], stamped: Stamped) -> None:
    """Add an entry to a history, which may have later ones: messages may be logged in another order."""
    insort(history, stamped, key=_stamp)


def neighbours(history: list[Stamped], stamp: float, gap: float) -> list[Stamped]:
    """The entries on both sides of a time, without those more than `gap` from it [s]; one at the very time
    counts alone."""
    i = bisect_left(history, stamp, key=_stamp)
    near = [history[k] for k in (i - 1, i) if 0 <= k < len(history) and abs(history[k][0] - stamp) <= gap]
    return near[-1:] if near and near[-1][0] <= stamp else near


class TransformHistory:
    """Poses of frames in their parents', at the times when they were published."""

    def __init__(self) -> None:
        self._parent: dict[str, str] = {}
        self._static: set[str] = set()
        self._poses: dict[str, list[tuple[float, Float[ndarray, "4 4"]]]] = {}

    def add(self, message: Mapping[str, Any], static: bool) -> None:
        """Take a geometry_msgs/TransformStamped, in plain data, into account."""
        child = message["child_frame_id"].lstrip("/")
        place, turn = message["transform"]["translation"], message["transform"]["rotation"]
        quaternion = np.array([turn[axis] for axis in "wxyz"])
        length = np.linalg.norm(quaternion)
        if not length > 0:
            raise InputError(f"the transform of {child} has the rotation {quaternion.tolist()}")
        rotation = rotation_from_quaternion(quaternion / length)
        T = transform(np.array([place[axis] for axis in "xyz"]), rotation)
        self._parent[child] = message["header"]["frame_id"].lstrip("/")
        if static:
            self._static.add(child)
        stamped = header_seconds(message["header"]["stamp"]), T
        insert_by_time(self._poses.setdefault(child, []), stamped)

    def at(self, base: str, frame: str, stamp: float, gap: float, where: str) -> Float[ndarray, "4 4"]:
        """T_base_frame at a time, interpolated between two transforms at most `gap` from it [s].

        Raises InputError, naming `where`, if no chain of transforms leads from the base to the frame, or if
        one of them is not near in time.
        """
        T, at = np.eye(4), frame.lstrip("/")
        passed = [at]
        while at != base.lstrip("/"):
            if at not in self._parent or len(passed) > len(self._parent) + 1:
                raise InputError(
                    f"no transforms lead from {base} to {frame}, the frame of {where}; from there they lead"
                    f" to {', '.join(passed[1:]) or 'nothing'}"
                )
            T = self._one(at, stamp, gap, where) @ T
            at = self._parent[at]
            passed.append(at)
        return T

    def _one(self, frame: str, stamp: float, gap: float, where: str) -> Float[ndarray, "4 4"]:
        """The pose of a frame in its parent's."""
        poses = self._poses[frame]
        if frame in self._static:
            return poses[-1][1]
        near = neighbours(poses, stamp, gap)
        if not near:
            raise InputError(f"there is no transform of {frame} within {gap:g} s of {where}")
        if len(near) == 1:
            return near[0][1]
        (t0, first), (t1, last) = near
        share = (stamp - t0) / (t1 - t0)
        turn = Slerp([0, 1], Rotation.from_matrix([first[:3, :3], last[:3, :3]]))(share).as_matrix()
        return transform((1 - share) * first[:3, 3] + share * last[:3, 3], turn)
