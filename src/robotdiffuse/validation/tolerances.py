"""The validator's settings, and the error of a configuration with respect to a goal."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.core.settings import Natural, NotNegative, Positive, Settings, ShareBetween
from robotdiffuse.core.transforms import inverse, rotation_angle, rpy_from_rotation
from robotdiffuse.core.types import (
    Configuration,
    Configurations,
    JointRows,
    Mask,
    Pose,
    Values,
    interpolated,
    step_lengths,
)
from robotdiffuse.problems.problem import AnyGoal, Goal, JointGoal, PosesGoal, goals_of
from robotdiffuse.robots.robot import Robot


@dataclass(frozen=True)
class VerifySettings(Settings, name="verify"):
    """Tolerances of the validator."""

    contact: Positive = 1e-4
    """Meshes closer than this count as touching [m]. A smaller value takes longer to certify."""
    limit_slack: NotNegative = 1e-6
    """Joint limits may be exceeded by this [rad] or [m]."""
    start_tolerance: NotNegative = 1e-6
    """Largest difference of any joint from the problem's start [rad] or [m]."""
    goal_tolerance: NotNegative = 1e-4
    """Largest difference of any joint from one of the goal configurations [rad] or [m]."""
    goal_distance: NotNegative = 0.01
    """Largest distance from the position of a goal pose [m] (the paper's 1 cm)."""
    goal_angle: NotNegative = float(np.radians(15))
    """Largest angle from the orientation of a goal pose [rad] (the paper's 15 degrees)."""
    goal_slack: NotNegative = 1e-5
    """The tolerances in a pose goal may be exceeded by this [m] or [rad]."""
    rest: NotNegative = 1e-6
    """At a waypoint where the motion must stop, no joint may be faster than this [rad/s] or [m/s]."""
    rate_slack: NotNegative = 0.01
    """Fraction by which a trajectory may exceed velocity, acceleration, effort and speed limits. A velocity
    may also differ by this fraction of its limit from the velocity that the positions give, from the
    problem's `start_velocity` (or zero) at the start, and from zero at the end."""
    rate_agreement: NotNegative = 0.5
    """How far a row's acceleration may be outside of the range between the accelerations of the two cubics
    that meet at the row, as a fraction of the joint's greatest acceleration."""
    jump: Positive = 1.5
    """A step between rows is a jump if a joint's mean velocity exceeds its velocity limit by this factor."""
    chord: Positive = 1e-3
    """Controllers follow cubics between rows, but collision is validated on straight lines. Rows on a cubic
    are added until it leaves the lines by at most this [rad] or [m]; more are added if the clearance is
    small."""
    constraint_chord: Positive = 1e-6
    """`chord` for validating path constraints. The tolerances of constraints are reduced to cover the
    deviation of the cubics from the lines."""
    reversal_angle: NotNegative = float(np.radians(150))
    """A change of direction in joint space by more than this [rad] is a sharp reversal."""
    reversal_step: NotNegative = 0.05
    """Reversals are counted between rows that are at least this far apart [rad, joint-space L2]."""
    reversals: Natural = 3
    """Largest allowed number of sharp reversals; a motion with more of them twitches."""
    tightness: ShareBetween = 0.5
    """The certified clearances of a `Report` are at least this fraction of the smallest measured clearance,
    before the deviation of a trajectory's cubics is subtracted."""


DEFAULT = VerifySettings()
EXACT = VerifySettings(goal_distance=1e-4, goal_angle=1e-4)
"""Tight tolerances, by which `goal_index` distinguishes goals that are close to each other."""
BLEND_SAMPLE_SHARE = 0.25
"""Largest joint-space distance (L2) between configurations at which `first_place_within` tests a path, per
unit of the blend."""


class GoalError(NamedTuple):
    """Why a configuration is not at a goal."""

    message: str
    subject: str | None
    """The frame of a pose goal."""
    excess: float
    """Largest joint error [rad] or [m], or the position error of a pose [m]."""


def goal_error(
    robot: Robot,
    goal: Goal,
    q: Configuration,
    settings: VerifySettings = DEFAULT,
    blend: float = 0.0,
    poses: dict[str, Pose] | None = None,
) -> GoalError | None:
    """The error of a configuration with respect to a goal; None if it is at the goal. For an `AnyGoal`, the
    smallest error.

    Args:
        robot: The robot.
        goal: The goal.
        q: The configuration.
        settings: Tolerances.
        blend: Distance at which the goal counts as reached: to a goal configuration [rad, joint-space L2]; to
            the position of a pose, or to the box of its tolerances [m].
        poses: Cache of the poses T_base_link at q by link, which this function fills.
    """
    poses = {} if poses is None else poses
    if isinstance(goal, AnyGoal):
        errors = list[GoalError]()
        for part in goal.goals:
            error = goal_error(robot, part, q, settings, blend, poses)
            if error is None:  # the others need not be computed
                return None
            errors.append(error)
        return min(errors, key=lambda error: error.excess)
    if isinstance(goal, PosesGoal):
        parts = (goal_error(robot, part, q, settings, blend, poses) for part in goal.poses)
        return max(parts, key=lambda error: error.excess if error else -1.0)
    if isinstance(goal, JointGoal):
        differences = goal.positions - q
        differences -= robot.whole_turns(differences)
        off = float(np.abs(differences).max(axis=1).min(initial=np.inf))
        if off <= settings.goal_tolerance or np.linalg.norm(differences, axis=1).min() <= blend:
            return None
        return GoalError(f"{off:.3g} from the nearest goal configuration (largest joint error)", None, off)
    if goal.frame not in poses:
        poses[goal.frame] = robot.fk(q, goal.frame)
    T_goal_end = inverse(goal.T_base_frame) @ poses[goal.frame]
    distance = float(np.linalg.norm(T_goal_end[:3, 3]))
    angle = rotation_angle(T_goal_end[:3, :3])
    xyz = goal.xyz_tolerance
    rpy = goal.rpy_tolerance
    slack = settings.goal_slack
    if xyz is None:
        at_goal = distance <= max(settings.goal_distance, blend)
    else:
        beyond = np.maximum(np.abs(T_goal_end[:3, 3]) - xyz - slack, 0.0)
        at_goal = bool(np.linalg.norm(beyond) <= blend)
    oriented = (
        angle <= settings.goal_angle if rpy is None else _orientation_within(T_goal_end[:3, :3], rpy, slack)
    )
    if at_goal and oriented:
        return None
    more = "" if xyz is None and rpy is None else ", which is beyond its tolerances"
    message = (
        f"with {goal.frame} {distance * 100:.2f} cm and {np.degrees(angle):.1f} degrees off the goal "
        f"pose{more}"
    )
    return GoalError(message, goal.frame, distance)


def goal_index(robot: Robot, goal: Goal, q: Configuration) -> int | None:
    """Index of the goal that a configuration reaches, among the goals of an `AnyGoal` or the rows of several
    goal configurations; None if it reaches no goal. Goals that are reached exactly come before others."""
    goals: Sequence[Goal] = goals_of(goal)
    if isinstance(goal, JointGoal):
        goals = [JointGoal(row) for row in goal.positions]
    poses = dict[str, Pose]()
    for settings in (EXACT, DEFAULT):
        for i, single_goal in enumerate(goals):
            if goal_error(robot, single_goal, q, settings, poses=poses) is None:
                return i
    return None


def first_place_within(
    robot: Robot,
    goal: Goal,
    q: Configurations,
    blend: float,
    settings: VerifySettings,
    after: float,
) -> float | None:
    """The first place from `after` on where a path through configurations is within `blend` of a goal.

    A place is the index of a row plus the traveled fraction of the segment after it. None if no sample of the
    path is that near; samples are at most BLEND_SAMPLE_SHARE of the blend apart.
    """
    places, samples = sample_path(q, BLEND_SAMPLE_SHARE * blend, after)
    for i in np.flatnonzero(_near(robot, goal, samples, blend, settings)):
        if goal_error(robot, goal, samples[i], settings, blend) is None:
            return float(places[i])
    return None


def sample_path(q: Configurations, step: float, after: float = 0.0) -> tuple[Values, JointRows]:
    """Places on a path from `after` on, at most `step` apart [rad, joint-space L2], and the configurations
    there. A place is the index of a row plus the traveled fraction of the segment after it."""
    steps = step_lengths(q)
    counts = np.maximum(np.ceil(steps / step), 1).astype(int)
    shares = [np.arange(count) / count for count in counts]
    places = np.append(np.repeat(np.arange(len(counts)), counts) + np.concatenate([[], *shares]), len(counts))
    places = places[places >= after]
    return places, interpolated(places, np.arange(float(len(q))), q)


def _near(robot: Robot, goal: Goal, q: Configurations, blend: float, settings: VerifySettings) -> Mask:
    """Whether each configuration may be within `blend` of a goal; orientations of poses are not checked."""
    if isinstance(goal, AnyGoal):
        return np.any([_near(robot, part, q, blend, settings) for part in goal.goals], axis=0)
    if isinstance(goal, PosesGoal):
        return np.all([_near(robot, part, q, blend, settings) for part in goal.poses], axis=0)
    if isinstance(goal, JointGoal):
        differences = goal.positions[:, None] - q
        differences -= robot.whole_turns(differences)
        reach = blend + settings.goal_tolerance * np.sqrt(robot.dof)
        return (np.linalg.norm(differences, axis=2) <= reach).any(axis=0)
    xyz = goal.xyz_tolerance
    tolerance = settings.goal_distance if xyz is None else float(np.linalg.norm(xyz + settings.goal_slack))
    offsets = robot.fk(q, goal.frame)[:, :3, 3] - goal.T_base_frame[:3, 3]
    return np.linalg.norm(offsets, axis=1) <= tolerance + blend


def _orientation_within(rotation: ndarray, tolerance: ndarray, slack: float) -> bool:
    """Whether roll, pitch and yaw of a rotation are within the tolerances [3]. Each rotation has two triples
    of these angles; one within the tolerances is enough."""
    roll, pitch, yaw = rpy_from_rotation(rotation)
    alternative = np.array([roll + np.pi, np.pi - pitch, yaw + np.pi])
    representations = np.array([roll, pitch, yaw]), (alternative + np.pi) % (2 * np.pi) - np.pi
    return any((np.abs(angles) <= tolerance + slack).all() for angles in representations)
