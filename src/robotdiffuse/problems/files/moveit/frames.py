"""The frames in which a MoveIt planning scene gives the poses of its objects."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.core.transforms import inverse
from robotdiffuse.problems.files.moveit.values import list_of, mapping_of, pose_of
from robotdiffuse.robots.robot import Robot


class MoveItFrames(dict[str, ndarray]):
    """T_base_frame of the frames that objects of a planning scene may be given in; '' is the scene's own.

    These are the scene's own frame, the frames that the file defines, and the links that fixed joints connect
    with the robot's base. Looking up an unknown frame raises InputError, which lists the known frames, or
    says why the pose of the robot's base in the scene is unknown.
    """

    def __init__(
        self, robot: Robot | None, T_own_root: Float[ndarray, "4 4"], own: tuple[str, ...] = ("", "world")
    ) -> None:
        """own: names of the scene's own frame; T_own_root: pose of the URDF's root in it."""
        super().__init__({} if robot is None else robot.above | robot.links_fixed_to_base)
        self.links = frozenset(self)
        """Frames of the robot, whose poses a file cannot change."""
        T_base_root = np.eye(4) if robot is None else robot.T_base_root
        self.lost = ""
        """Why the pose of the scene's own frame is unknown; empty if it is known."""
        if T_base_root is not None:
            T_base_own = T_base_root @ inverse(T_own_root)
            self.update({name: T_base_own for name in own if name not in self.links})
        elif robot is not None:
            self.lost = f"a joint moves {robot.base} in {robot.root}"

    def of(self, where: str, entry: dict[str, Any]) -> Float[ndarray, "4 4"]:
        """T_base_frame of the frame that the header of an entry names."""
        name = str(mapping_of(f"{where}.header", entry.get("header")).get("frame_id") or "").removeprefix("/")
        if name in self:
            return self[name]
        known = [frame for frame in self if frame]
        if self.lost:
            raise InputError(
                f"frame_id of {where} is {shown(name)}, and the pose of the robot's base in it is unknown: "
                f"{self.lost}; known frames: {', '.join(known)}"
            )
        raise unknown_name(f"frame_id of {where}:", name, known)


def moveit_frames(data: object, robot: Robot | None = None) -> MoveItFrames:
    """The frames of a parsed planning scene; `robot` as in `read_moveit_scene`.

    The scene's own frame is the one in which robot_state.multi_dof_joint_state gives the pose of the robot,
    by default `world`. Raises InputError if it has more than one transform, that of the robot's root.
    """
    state = mapping_of("robot_state", mapping_of("a planning scene", data).get("robot_state"))
    if state.get("attached_collision_objects"):
        raise InputError("attached_collision_objects are for the start_state of a request")
    floating = mapping_of("multi_dof_joint_state", state.get("multi_dof_joint_state"))
    transforms = list_of("multi_dof_joint_state.transforms", floating.get("transforms"))
    T_own_root = np.eye(4)
    if len(transforms) > 1:
        raise InputError(
            f"multi_dof_joint_state has {len(transforms)} transforms; it must have one, of the robot's root"
        )
    if transforms:
        T_own_root = pose_of("multi_dof_joint_state.transforms[0]", transforms[0], "translation", "rotation")
    header = mapping_of("multi_dof_joint_state.header", floating.get("header"))
    named = str(header.get("frame_id") or "").removeprefix("/")
    root = "" if robot is None else robot.root or robot.base
    frames = MoveItFrames(robot, T_own_root, ("", "world" if named in ("", root) else named))
    fixed = list_of(
        "fixed_frame_transforms", mapping_of("a planning scene", data).get("fixed_frame_transforms")
    )
    for i, entry in enumerate(fixed):
        where = f"fixed_frame_transforms[{i}]"
        entry = mapping_of(where, entry)
        child = str(entry.get("child_frame_id", "")).removeprefix("/")
        T = pose_of(f"{where}.transform", entry.get("transform"), "translation", "rotation")
        if not frames.lost and child not in frames.links:
            frames[child] = frames.of(where, entry) @ T
    return frames
