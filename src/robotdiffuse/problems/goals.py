"""Goals: configurations, poses of one or several links with tolerances, or any of several goals.

As with shapes, the constructors check their arguments themselves: see `no_type_check` in scenes/shapes.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import no_type_check

import numpy as np

from robotdiffuse.core.bounds import MAX_COORDINATE, Value, numbers, rigid_transform
from robotdiffuse.core.errors import InputError, check_list, repeated, shown
from robotdiffuse.core.types import GivenConfigurations, GivenPose, Pose, VectorOrNone

MAX_TURN = 3.2
"""Largest tolerance of an angle, a little more than half a turn [rad]; larger numbers can only be degrees."""


@no_type_check
@dataclass(frozen=True, eq=False)
class JointGoal(Value):
    """A goal reached at any of several configurations."""

    positions: GivenConfigurations
    """The configurations, one per row [rad] or [m]."""

    def __post_init__(self) -> None:
        positions = numbers(self.positions)
        if positions is None or positions.ndim not in (1, 2) or positions.size == 0:
            raise InputError(
                f"goal is {shown(self.positions)}; it must be a configuration, or a list of configurations "
                "of one length"
            )
        object.__setattr__(self, "positions", np.atleast_2d(positions))
        super().__post_init__()

    def moved(self, T: Pose) -> "JointGoal":
        """Do nothing, since configurations do not move with poses.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            This goal.
        """
        return self


@no_type_check
@dataclass(frozen=True, eq=False)
class PoseGoal(Value):
    """A pose of a link. Without tolerances, the path must end within 1 cm and 15 degrees of it, as in the
    paper.

    With tolerances, the final pose of the link, in the frame of the goal, must have xyz and rpy within plus
    and minus the tolerances. xyz is a position along the goal's axes; rpy are roll, pitch and yaw about the
    goal's x, y and z axes, in the order of URDFs. A yaw tolerance of pi thus allows any turn about z. All
    poses within the tolerances are equally good.
    """

    frame: str
    """Name of the link."""
    T_base_frame: GivenPose
    """Pose of the link [4, 4]."""
    xyz_tolerance: VectorOrNone = None  # pyright: ignore[reportAssignmentType]
    """Tolerance of the position along the axes of the goal [m]; None: the exact position, validated to 1
    cm."""
    rpy_tolerance: VectorOrNone = None  # pyright: ignore[reportAssignmentType]
    """Tolerance of the orientation about the axes of the goal [rad], pi for any angle; None: the exact
    orientation, validated to 15 degrees."""

    def __post_init__(self) -> None:
        if not isinstance(self.frame, str):
            raise InputError(f"goal.frame is {shown(self.frame)}; it must be the name of a link")
        object.__setattr__(self, "T_base_frame", rigid_transform("goal.T_base_frame", self.T_base_frame))
        for name, most, unit in (("xyz_tolerance", MAX_COORDINATE, "m"), ("rpy_tolerance", MAX_TURN, "rad")):
            value = getattr(self, name)
            if value is not None:
                array = numbers(value)
                if array is None or array.shape != (3,) or not ((array >= 0) & (array <= most)).all():
                    raise InputError(
                        f"goal.{name} is {shown(value)}; it must be 3 numbers from 0 to {most:g} [{unit}]"
                    )
                object.__setattr__(self, name, array)
        super().__post_init__()

    def moved(self, T: Pose) -> "PoseGoal":
        """Move the pose.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The goal after the motion.
        """
        return replace(self, T_base_frame=T @ self.T_base_frame)

    @property
    def tolerant(self) -> bool:
        """Whether more than one pose reaches the goal."""
        return any(t is not None and t.max() > 0 for t in (self.xyz_tolerance, self.rpy_tolerance))


@no_type_check
@dataclass(frozen=True, eq=False)
class PosesGoal(Value):
    """A pose for each of several links at once, e.g. for both hands of two arms, each with its tolerances."""

    poses: Sequence[PoseGoal]
    """One for each link."""

    def __post_init__(self) -> None:
        check_list("goal.poses", self.poses, PoseGoal, "rd.PoseGoal", least=1)
        twice = repeated(pose.frame for pose in self.poses)
        if twice:
            raise InputError(f"goal.poses names {twice[0]!r} twice; each link has one pose")
        object.__setattr__(self, "poses", tuple(self.poses))

    def moved(self, T: Pose) -> "PosesGoal":
        """Move all poses.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The goal after the motion.
        """
        return PosesGoal([pose.moved(T) for pose in self.poses])

    @property
    def tolerant(self) -> bool:
        """Whether any link has more than one pose that reaches the goal."""
        return any(pose.tolerant for pose in self.poses)


@no_type_check
@dataclass(frozen=True, eq=False)
class AnyGoal(Value):
    """Several goals, any of which may be reached. The goals of an AnyGoal among them become goals of this
    one."""

    goals: "tuple[OneGoal, ...]"
    """At least one; `PlanResult.goal_index` counts them from 0."""

    def __post_init__(self) -> None:
        types = "rd.JointGoal, rd.PoseGoal, rd.PosesGoal and rd.AnyGoal"
        check_list("goal.goals", self.goals, Goal, types, least=1)
        goals = [goal.goals if isinstance(goal, AnyGoal) else (goal,) for goal in self.goals]
        object.__setattr__(self, "goals", tuple(chain(*goals)))

    def moved(self, T: Pose) -> "AnyGoal":
        """Move all goals.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The goals after the motion.
        """
        return AnyGoal(tuple(goal.moved(T) for goal in self.goals))


OneGoal = JointGoal | PoseGoal | PosesGoal
Goal = OneGoal | AnyGoal


def poses_of(goal: Goal) -> Sequence[PoseGoal]:
    """The poses that must be reached together; empty for configurations and for AnyGoal."""
    if isinstance(goal, PosesGoal):
        return goal.poses
    return (goal,) if isinstance(goal, PoseGoal) else ()
