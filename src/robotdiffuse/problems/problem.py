"""Problem: a robot, a scene, a start and a goal; and what cameras saw of the scene.

As with shapes, the constructors check their arguments themselves: see `no_type_check` in scenes/shapes.py.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, no_type_check

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.checks import LARGEST, numbers, within
from robotdiffuse.errors import InputError, shown, unknown_name
from robotdiffuse.robots.robot import Joint, Robot
from robotdiffuse.scenes.depth_view import DepthView, SeenPoints
from robotdiffuse.scenes.scene import Scene

LIMIT_SLACK = 1e-5
"""Configurations that exceed a joint limit by no more than this are clamped, with a note [rad]."""
RIGID_SLACK = 1e-4
"""How far the rotation part of a pose may be from orthonormal, by entry."""
OPTIMISTIC, PADDED, IMAGINED, OCCUPIED = "optimistic", "padded", "imagined", "occupied"
UNSEEN = (OPTIMISTIC, PADDED, IMAGINED, OCCUPIED)
"""What space that no view saw is taken for: free; free but near what was seen; as the completing network
imagines it; occupied. See `planners/unseen.py`."""


@no_type_check
@dataclass(frozen=True, eq=False)
class JointGoal:
    """Any of these configurations (one row each)."""

    positions: Float[ndarray, "n dof"]

    def __post_init__(self) -> None:
        positions = numbers(self.positions)
        if positions is None or positions.ndim not in (1, 2) or positions.size == 0:
            raise InputError(
                f"goal is {shown(self.positions)}; it must be a configuration or a list of them of one length"
            )
        object.__setattr__(self, "positions", np.atleast_2d(positions))

    if TYPE_CHECKING:

        def __init__(self, positions: ArrayLike) -> None: ...


@no_type_check
@dataclass(frozen=True, eq=False)
class PoseGoal:
    """A pose of a link; the path must end within 1 cm and 15 degrees of it (the paper's tolerances)."""

    frame: str
    """Name of the link."""
    T_base_frame: Float[ndarray, "4 4"]

    def __post_init__(self) -> None:
        if not isinstance(self.frame, str):
            raise InputError(f"goal.frame is {shown(self.frame)}; it must be the name of a link")
        T = numbers(self.T_base_frame)
        if T is None or T.shape != (4, 4) or not within(T):
            raise InputError(
                f"goal.T_base_frame is {shown(self.T_base_frame)}; it must be 4 x 4 finite numbers within "
                f"±{LARGEST:g}"
            )
        rotation = T[:3, :3]
        orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() <= RIGID_SLACK
        if not orthonormal or np.linalg.det(rotation) < 0 or (T[3] != [0, 0, 0, 1]).any():
            raise InputError(
                f"goal.T_base_frame is {shown(T)}; it must be a rotation and a translation over a row 0 0 0 1"
            )
        object.__setattr__(self, "T_base_frame", T)

    if TYPE_CHECKING:

        def __init__(self, frame: str, T_base_frame: ArrayLike) -> None: ...


@no_type_check
@dataclass(frozen=True, eq=False)
class Problem:
    """`goal` may be given as a configuration, a list of them, a JointGoal or a PoseGoal.

    Values up to `LIMIT_SLACK` beyond a joint limit are clamped, with a note; those of continuous joints are
    kept as they are, and whole turns of a goal do not matter. Raises InputError for everything else that no
    planner could work with: wrong lengths, values that are not finite or out of limits, a goal frame that the
    robot does not move. Collisions of start and goal are found by the planners.

    With views, the problem's scene is the given one and what they saw beside it, as points (`SeenPoints`).
    """

    robot: Robot
    scene: Scene
    start: Float[ndarray, "dof"]
    goal: JointGoal | PoseGoal
    notes: tuple[str, ...] = ()
    """What was changed in the input, e.g. a start clamped to a limit."""
    clearance: float | None = None
    """Distance to obstacles that is to be kept where start, goal and passages allow it [m]; None: what the
    call of the planner says."""
    views: tuple[DepthView, ...] = ()
    """Pictures that depth cameras took of the scene."""
    unseen: str = OPTIMISTIC
    """What space that no view saw is taken for, one of UNSEEN; of no account without views."""

    def __post_init__(self) -> None:
        if self.clearance is not None:
            check_clearance("clearance", self.clearance)
        if not isinstance(self.robot, Robot):
            raise InputError(f"robot is {shown(self.robot)}; it must be a Robot, e.g. rd.load_robot('panda')")
        if not isinstance(self.scene, Scene):
            raise InputError(f"scene is {shown(self.scene)}; it must be a Scene, e.g. rd.Scene([shape, ...])")
        notes = list(self.notes)
        start = _configuration(self.robot, "start", self.start, notes)
        goal = self.goal
        if isinstance(goal, PoseGoal):
            moved = [link for link in self.robot.link_names if self.robot.link_frame(link) > 0]
            if goal.frame not in self.robot.link_names:
                raise unknown_name("link in goal.frame:", goal.frame, moved)
            if goal.frame not in moved:
                raise InputError(
                    f"goal.frame {shown(goal.frame)} is moved by no planned joint; these are: "
                    f"{', '.join(moved)}"
                )
        else:
            rows = goal.positions if isinstance(goal, JointGoal) else JointGoal(goal).positions
            fields = ["goal"] if len(rows) == 1 else [f"goal[{i}]" for i in range(len(rows))]
            goal = JointGoal(
                np.stack([_configuration(self.robot, *row, notes) for row in zip(fields, rows, strict=True)])
            )
        views = _views(self.robot, self.views)
        check_unseen("unseen", self.unseen)
        scene = self.scene
        if views:
            from robotdiffuse.problems.seen import seen_shapes  # compiled code, which only views need

            scene = self.known_scene
            ends = goal.positions if isinstance(goal, JointGoal) else start[None]
            scene = Scene([*scene.shapes, *seen_shapes(views, self.robot, scene, start, ends)])
        for key, value in {
            "scene": scene,
            "start": start,
            "goal": goal,
            "notes": tuple(notes),
            "views": views,
        }.items():
            object.__setattr__(self, key, value)

    if TYPE_CHECKING:

        def __init__(
            self,
            robot: Robot,
            scene: Scene,
            start: ArrayLike,
            goal: ArrayLike | JointGoal | PoseGoal,
            notes: tuple[str, ...] = (),
            clearance: float | None = None,
            views: Sequence[DepthView] = (),
            unseen: str = OPTIMISTIC,
        ) -> None: ...

    @property
    def known_scene(self) -> Scene:
        """The scene as it was given: without what the views saw."""
        known = [shape for shape in self.scene.shapes if not isinstance(shape, SeenPoints)]
        return self.scene if len(known) == len(self.scene.shapes) else Scene(known)

    load: ClassVar[Callable[..., "Problem"]]
    """`problems.files.load_problem`, put here by the package: files know problems, not the reverse."""


def check_clearance(field: str, value: object) -> float:
    """The value as a distance [m]; InputError unless it is a finite number from 0 on."""
    clearance = numbers(value)
    if clearance is None or clearance.ndim != 0 or not 0 <= clearance <= LARGEST:
        raise InputError(f"{field} is {shown(value)}; it must be a distance from 0 to {LARGEST:g} m")
    return float(clearance)


def check_unseen(field: str, value: object) -> str:
    """The value as one of UNSEEN; InputError for anything else."""
    if not isinstance(value, str) or value not in UNSEEN:
        raise unknown_name(f"policy in {field}:", str(value), UNSEEN)
    return value


def _views(robot: Robot, views: object) -> tuple[DepthView, ...]:
    if not isinstance(views, list | tuple) or not all(isinstance(view, DepthView) for view in views):
        raise InputError(f"views is {shown(views)}; it must be a list of rd.DepthView")
    for i, view in enumerate(views):
        if view.configuration is not None and len(view.configuration) != robot.dof:
            raise InputError(
                f"views[{i}].configuration has {len(view.configuration)} values; {robot.name} has "
                f"{robot.dof} planned joints: {', '.join(robot.joint_names)}"
            )
    return tuple(views)


def _configuration(robot: Robot, field: str, value: object, notes: list[str]) -> Float[ndarray, "dof"]:
    """The configuration within limits; appends to `notes` what was changed."""
    q = numbers(value)
    names = ", ".join(robot.joint_names)
    if q is None or q.ndim != 1:
        raise InputError(f"{field} is {shown(value)}; it must be a list of {robot.dof} numbers: {names}")
    if len(q) != robot.dof:
        raise InputError(f"{field} has {len(q)} values; {robot.name} has {robot.dof} planned joints: {names}")
    return np.array([_position(field, *pair, notes) for pair in zip(robot.planned_joints, q, strict=True)])


def _position(field: str, joint: Joint, value: float, notes: list[str]) -> float:
    unit = "m" if joint.kind == "prismatic" else "rad"
    if not abs(value) <= LARGEST:
        raise InputError(
            f"{field}: {joint.name} is {value}; it must be a finite number within ±{LARGEST:g} [{unit}]"
        )
    if joint.kind == "continuous":
        return float(value)
    within = float(np.clip(value, joint.lower, joint.upper))
    if abs(value - within) > LIMIT_SLACK:
        raise InputError(
            f"{field}: {joint.name} is {value:g} {unit}; its limits are {joint.lower:g} to {joint.upper:g}"
        )
    if value != within:
        notes.append(f"{field}: {joint.name} clamped from {float(value)!r} to its limit {within!r} {unit}")
    return within
