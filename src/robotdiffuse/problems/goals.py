"""Where a motion is to end: configurations, poses of links with what they may be off, poses of several
links at once, or any of several.

As with shapes, the constructors check their arguments themselves: see `no_type_check` in scenes/shapes.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, no_type_check

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import Value, numbers, rigid_transform
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.transforms import rotation_from_rpy, transform

INWARDS = 1e-3
"""Poses are drawn within tolerances less this share: inverse kinematics has an error of its own."""


@no_type_check
@dataclass(frozen=True, eq=False)
class JointGoal(Value):
    """Any of these configurations (one row each)."""

    positions: Float[ndarray, "n dof"]

    def __post_init__(self) -> None:
        positions = numbers(self.positions)
        if positions is None or positions.ndim not in (1, 2) or positions.size == 0:
            raise InputError(
                f"goal is {shown(self.positions)}; it must be a configuration or a list of them of one length"
            )
        object.__setattr__(self, "positions", np.atleast_2d(positions))
        super().__post_init__()

    if TYPE_CHECKING:

        def __init__(self, positions: ArrayLike) -> None: ...


@no_type_check
@dataclass(frozen=True, eq=False)
class PoseGoal(Value):
    """A pose of a link. Without tolerances, the path must end within 1 cm and 15 degrees of it (the paper's).

    With them, the pose where the link ends, seen from the goal, has xyz and rpy within plus and minus these:
    a box along the goal's axes, and roll, pitch and yaw about its x, y and z in the order of URDFs, so that a
    yaw of pi is any turn about z. Any pose within is as good.
    """

    frame: str
    """Name of the link."""
    T_base_frame: Float[ndarray, "4 4"]
    xyz_tolerance: Float[ndarray, "3"] | None = None
    """Along the axes of the goal [m]; None: the very position, validated to 1 cm."""
    rpy_tolerance: Float[ndarray, "3"] | None = None
    """About them [rad], pi for any angle; None: the very orientation, validated to 15 degrees."""

    def __post_init__(self) -> None:
        if not isinstance(self.frame, str):
            raise InputError(f"goal.frame is {shown(self.frame)}; it must be the name of a link")
        object.__setattr__(self, "T_base_frame", rigid_transform("goal.T_base_frame", self.T_base_frame))
        for name, unit in (("xyz_tolerance", "m"), ("rpy_tolerance", "rad")):
            value = getattr(self, name)
            if value is not None:
                array = numbers(value)
                if array is None or array.shape != (3,) or not ((array >= 0) & (array < np.inf)).all():
                    raise InputError(
                        f"goal.{name} is {shown(value)}; it must be 3 finite numbers of at least 0 [{unit}]"
                    )
                object.__setattr__(self, name, array)
        super().__post_init__()

    if TYPE_CHECKING:

        def __init__(
            self,
            frame: str,
            T_base_frame: ArrayLike,
            xyz_tolerance: ArrayLike | None = None,
            rpy_tolerance: ArrayLike | None = None,
        ) -> None: ...

    @property
    def tolerant(self) -> bool:
        """Whether more than one pose will do."""
        return any(t is not None and t.max() > 0 for t in (self.xyz_tolerance, self.rpy_tolerance))

    def draw(self, rng: np.random.Generator) -> Float[ndarray, "4 4"]:
        """T_base_frame of a pose within the tolerances, uniformly by each of the six."""
        free = np.zeros((2, 3))
        for i, tolerance in enumerate((self.xyz_tolerance, self.rpy_tolerance)):
            if tolerance is not None:
                free[i] = np.minimum(tolerance, np.inf if i == 0 else np.pi) * (1 - INWARDS)
        xyz, rpy = rng.uniform(-1.0, 1.0, (2, 3)) * free
        return self.T_base_frame @ transform(xyz, rotation_from_rpy(*rpy))


@no_type_check
@dataclass(frozen=True, eq=False)
class PosesGoal(Value):
    """A pose for each of several links at once, for each hand of two arms say, each with its tolerances."""

    poses: tuple[PoseGoal, ...]

    def __post_init__(self) -> None:
        poses = self.poses if isinstance(self.poses, list | tuple) else ()
        if not poses or not all(isinstance(pose, PoseGoal) for pose in poses):
            raise InputError(f"goal.poses is {shown(self.poses)}; it must be a list of rd.PoseGoal")
        frames = [pose.frame for pose in poses]
        twice = next((frame for frame in frames if frames.count(frame) > 1), None)
        if twice is not None:
            raise InputError(f"goal.poses names {twice!r} twice; each link has one pose")
        object.__setattr__(self, "poses", tuple(poses))

    if TYPE_CHECKING:

        def __init__(self, poses: Sequence[PoseGoal]) -> None: ...

    @property
    def tolerant(self) -> bool:
        """Whether more than one pose of any link will do."""
        return any(pose.tolerant for pose in self.poses)


@no_type_check
@dataclass(frozen=True, eq=False)
class AnyGoal(Value):
    """Any of several goals."""

    goals: "tuple[OneGoal, ...]"

    def __post_init__(self) -> None:
        goals = self.goals if isinstance(self.goals, list | tuple) else ()
        if not goals or not all(isinstance(goal, OneGoal) for goal in goals):
            raise InputError(
                f"goal.goals is {shown(self.goals)}; it must be a list of rd.JointGoal, rd.PoseGoal and "
                "rd.PosesGoal"
            )
        object.__setattr__(self, "goals", tuple(goals))


OneGoal = JointGoal | PoseGoal | PosesGoal
Goal = OneGoal | AnyGoal


def poses_of(goal: Goal) -> tuple[PoseGoal, ...]:
    """The poses that a goal asks for together; none of configurations, or of any of several goals."""
    if isinstance(goal, PosesGoal):
        return goal.poses
    return (goal,) if isinstance(goal, PoseGoal) else ()


def moved_goal(goal: Any, T: Float[ndarray, "4 4"]) -> Any:
    """The goal after a rigid motion: poses move, configurations do not."""
    if isinstance(goal, AnyGoal):
        return AnyGoal(tuple(moved_goal(one, T) for one in goal.goals))
    if isinstance(goal, PosesGoal):
        return PosesGoal([moved_goal(pose, T) for pose in goal.poses])
    if isinstance(goal, list | tuple):
        return [moved_goal(one, T) for one in goal]
    return replace(goal, T_base_frame=T @ goal.T_base_frame) if isinstance(goal, PoseGoal) else goal
