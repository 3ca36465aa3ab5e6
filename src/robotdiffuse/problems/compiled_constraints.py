"""PathConstraints: evaluates a problem's path constraints, proves that motions satisfy them, and projects
configurations onto them.

The compiled functions are in `constraint_kernel.py` and `projection_kernel.py`; this file builds the arrays
that they need and interprets their results.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, distinct
from robotdiffuse.core.transforms import inverse, rotation_about, rotation_angle, rotation_z_to, transform
from robotdiffuse.core.types import (
    Configuration,
    Configurations,
    JointRows,
    JointValues,
    Mask,
    Pose,
    Values,
    Vector,
    arc_lengths,
    for_kernels,
    interpolated,
)
from robotdiffuse.problems import constraint_kernel as kernel
from robotdiffuse.problems.constraint_kernel import CONE, DISTANCE, ROLL_PITCH_YAW, TURN, Rows
from robotdiffuse.problems.constraints import (
    AxisCone,
    CartesianLine,
    Constraint,
    OnPlane,
    PositionBox,
)
from robotdiffuse.problems.problem import JointGoal, PoseGoal, Problem, poses_of
from robotdiffuse.problems.projection_kernel import project_each
from robotdiffuse.robots.inverse_kinematics import KINDS
from robotdiffuse.robots.robot import Robot

MIN_SEGMENT_FRACTION = 1e-7
"""A proof does not split a piece of a segment that is at most this fraction of the segment."""
VIOLATION_STEP = 0.01
"""The maximum of a violation is searched for at configurations that are at most this far apart in joint space
[rad]."""
VIOLATION_STEPS = 1000
"""Maximum number of such steps that the search for the maximum takes."""
PROJECTION_FRACTION = 0.5
"""Projection aims at this fraction of a tolerance, to end well within the tolerance."""
POSE_TOLERANCE = 2e-6
"""Tolerance of the pose of a projected link [m], [rad]."""
GOAL_MARGIN = 1e-3
"""Fraction of a goal's tolerances that projected configurations do not use."""
INNER_GOAL_FRACTION = 0.9
"""Projection aims at this fraction of a goal's tolerances, after GOAL_MARGIN is subtracted."""
MIN_LINE_LENGTH = 1e-3
"""Along shorter lines, the orientation does not follow the position: the link turns in place [m]."""
SAME_POSE_TOLERANCE = 1e-3
"""Maximum difference of the poses of a line's link at the goal configurations [m], [rad]."""


class ConstraintViolation(NamedTuple):
    """A place where a constraint is violated, or not proved."""

    constraint: Constraint
    at: float
    """Place on the motion: waypoint index plus fraction of the segment after it; 0 for a configuration."""
    value: float
    """Largest constrained distance or angle until the constraint is satisfied again [m] or [rad]."""
    limit: float
    """Largest allowed distance or angle [m] or [rad]."""
    angular: bool
    """Whether `value` and `limit` are angles."""

    @property
    def excess(self) -> float:
        """Amount beyond the limit; 0 if the constraint was only not proved."""
        return max(self.value - self.limit, 0.0)

    @property
    def message(self) -> str:
        """A message with the constraint and the amount."""
        name = f"{self.constraint.kind} of {self.constraint.frame}"
        unit, scale = ("degrees", np.degrees(1.0)) if self.angular else ("mm", 1e3)
        if self.excess == 0.0:
            return f"{name} cannot be proved: the motion comes within rounding error of its limit"
        if self.limit <= 0.0:
            return f"{name} is violated by {scale * self.excess:.3g} {unit}"
        value, limit = distinct(scale * self.value, scale * self.limit, digits=4)
        return f"{name} is exceeded: {value} {unit}, of {limit} allowed"


class _Row(NamedTuple):
    """One row of `Rows`, for one frame."""

    row_kind: int
    limit: float
    tolerance: float
    reference_pose: ndarray = np.eye(4)
    half_size: ndarray = np.zeros(3)
    inner_half_size: ndarray = np.zeros(3)
    a: ndarray = np.zeros(3)
    b: ndarray = np.zeros(3)


class PathConstraints:
    """All path constraints of a problem, as rows of scalar constraints."""

    def __init__(
        self,
        problem: Problem,
        poses: Sequence[PoseGoal] = (),
        exact: tuple[float, float] = (POSE_TOLERANCE, POSE_TOLERANCE),
    ) -> None:
        """poses: additional goals for projection; each link must reach its pose within the pose's tolerances.
        exact: tolerances of the position [m] and of the orientation [rad] of poses that state none.

        Raises InputError if a Cartesian line has no unique end pose.
        """
        self.robot = problem.robot
        own = [(constraint, row) for constraint in problem.constraints for row in _rows(problem, constraint)]
        self.owners = [constraint for constraint, _ in own]
        """The constraint of each row."""
        goals = [(pose.frame, row) for pose in poses for row in _pose_rows(pose, *exact)]
        frames = [owner.frame for owner in self.owners] + [frame for frame, _ in goals]
        self.rows = _arrays(problem.robot, frames, [row for _, row in own + goals])
        self._speed_rows = [
            m
            for m, owner in enumerate(self.owners)
            if isinstance(owner, CartesianLine) and owner.speed is not None and own[m][1].row_kind == DISTANCE
        ]
        self.speed_limited = [self.owners[m] for m in self._speed_rows]
        """The constraints with a speed limit."""
        self.speed_limits = np.array([constraint.speed for constraint in self.speed_limited])  # type: ignore[union-attr]
        """Their speed limits [m/s]."""

    def values(self, q: Configurations) -> Float[ndarray, "n rows"]:
        """The value of each row [m] or [rad]."""
        return kernel.values(self.rows, for_kernels(q))

    def limits(self, tolerance_fraction: float) -> Values:
        """The largest allowed value of each row, if a fraction of its tolerance may be used [m] or [rad]."""
        return self.rows.limit - (1 - tolerance_fraction) * self.rows.tolerance

    def satisfied(self, q: Configurations, tolerance_fraction: float = 1.0) -> Mask:
        """Which configurations satisfy all constraints within a fraction of their tolerances."""
        return np.all(self.values(q) <= self.limits(tolerance_fraction), axis=1)

    def projected(self, q: Configurations, tolerance_fraction: float, most: int = -1) -> Configurations:
        """The configurations, projected so that they use at most a fraction of the tolerances. Failed
        projections are left out. most: stop after this many successful projections; -1: project all."""
        rows, satisfied = self.project(q, tolerance_fraction, most)
        return rows[satisfied]

    def project(
        self, q: Configurations, tolerance_fraction: float, most: int = -1
    ) -> tuple[Configurations, Mask]:
        """Like `projected`, but returns all configurations, and which of them keep the tolerances."""
        rows = np.array(q, np.float64, order="C")
        return rows, project_each(self.rows, self.limits(tolerance_fraction), rows, most)

    def worst_violation(self, q: Configuration) -> ConstraintViolation | None:
        """The violation of a configuration that is largest relative to the tolerance; None if there is
        none."""
        [values] = self.values(q[None])
        over = (values - self.rows.limit) / self.rows.tolerance
        row = int(over.argmax())
        return self._violation(row, 0.0, float(values[row])) if over[row] > 0 else None

    def first_violation(
        self, q: Configurations, chord: float = 0.0, tolerance_fraction: float = 1.0
    ) -> ConstraintViolation | None:
        """The first place where the straight segments through waypoints violate a constraint, or are not
        proved to satisfy it; None if all constraints are proved along all segments.

        chord: bound of the motion's deviation from the segments in each joint [rad] or [m]; limits are
        tightened to cover it. tolerance_fraction: the fraction of the tolerances that the motion may use.
        """
        q = for_kernels(q)
        rows = self.rows
        # how much a row's value can change if each joint deviates by `chord`; a TURN's desired orientation
        # depends on the position along the line, so it changes too
        own_change = np.where(rows.row_kind == DISTANCE, rows.lever_bounds.sum(axis=1), rows.chain_length)
        turning = (rows.row_kind == TURN) * np.linalg.norm(rows.a, axis=1) * np.linalg.norm(rows.b, axis=1)
        slack = chord * (own_change + turning * rows.lever_bounds.sum(axis=1))
        limits = self.limits(tolerance_fraction) - slack
        segment, fraction, row = kernel.first_unproved(rows, limits, q, MIN_SEGMENT_FRACTION)
        if row < 0:
            return None
        return self._violation(row, segment + fraction, self._maximum(q, segment, fraction, row))

    def speeds(self, q: Configurations, rates: JointRows) -> Float[ndarray, "n limited"]:
        """Speeds of the frames with a speed limit [m/s], one column each, at joint velocities `rates` [rad/s]
        or [m/s]."""
        columns = [kernel.speeds(self.rows, m, for_kernels(q), for_kernels(rates)) for m in self._speed_rows]
        return np.stack(columns, axis=1) if columns else np.zeros((len(q), 0))

    def third_derivative_bounds(self, derivatives: Float[ndarray, "3 n dof"]) -> Float[ndarray, "n limited"]:
        """Bounds on the third derivatives of the positions of the frames with a speed limit, on n pieces of a
        motion.

        By the chain rule, the third derivative of a position p is the sum of (d_j p) q'''_j,
        3 (d_jk p) q''_j q'_k and (d_jkl p) q'_j q'_k q'_l. A partial derivative of p with respect to several
        joints is at most as long as the lever of the last of them in the chain. The sum of all products of
        rates whose last joint is j is P(j) - P(j - 1), where P(j) is the product of the rates' sums over the
        joints up to j.

        derivatives: bounds on the first three derivatives of the joint positions, for each piece.
        """
        bounds = np.empty((derivatives.shape[1], len(self._speed_rows)))
        for k, m in enumerate(self._speed_rows):
            count = self.rows.chain_length[m]
            first, second, third = derivatives[:, :, self.rows.chain[m, :count]]
            first_sums = np.cumsum(first, axis=1)
            second_sums = np.cumsum(second, axis=1)
            products = np.diff(3 * second_sums * first_sums + first_sums**3, axis=1, prepend=0.0)
            bounds[:, k] = (third + products) @ self.rows.lever_bounds[m, :count]
        return bounds

    def _maximum(self, q: ndarray, segment: int, fraction: float, row: int) -> float:
        """The maximum value of a row from a place on the motion until the row is satisfied again."""
        following = min(segment + 1, len(q) - 1)
        at = q[segment] + fraction * (q[following] - q[segment])
        remaining = np.vstack([at, q[following:]])
        knots = arc_lengths(remaining)
        near = np.geomspace(MIN_SEGMENT_FRACTION, VIOLATION_STEP, 64)
        s = np.unique(np.concatenate([near, VIOLATION_STEP * np.arange(VIOLATION_STEPS), knots]))
        s = s[s <= min(knots[-1], VIOLATION_STEP * VIOLATION_STEPS)]
        values = self.values(interpolated(s, knots, remaining))[:, row]
        over = values > self.rows.limit[row]
        ends = np.flatnonzero(over[:-1] & ~over[1:])  # the last places of violations
        return float(values[: ends[0] + 1 if len(ends) else None].max())

    def _violation(self, row: int, at: float, value: float) -> ConstraintViolation:
        limit = float(self.rows.limit[row])
        angular = bool(self.rows.row_kind[row] != DISTANCE)
        return ConstraintViolation(self.owners[row], at, value, limit, angular)


def _rows(problem: Problem, constraint: Constraint) -> list[_Row]:
    if isinstance(constraint, AxisCone):
        angle = constraint.angle
        return [_Row(CONE, angle, angle, a=constraint.axis, b=constraint.direction)]
    if isinstance(constraint, PositionBox):
        half = (constraint.high - constraint.low) / 2
        T = constraint.T_base_box
        assert T is not None  # set by the constructor
        place = T @ transform((constraint.high + constraint.low) / 2)
        tolerance = float(half.min())
        return [_Row(DISTANCE, 0.0, tolerance, place, half, half - PROJECTION_FRACTION * tolerance)]
    if isinstance(constraint, CartesianLine):
        return _line_rows(problem, constraint)
    tolerance = constraint.tolerance
    if isinstance(constraint, OnPlane):
        z = constraint.normal
        half = np.array([np.inf, np.inf, 0.0])
    else:
        z = constraint.direction
        half = np.array([0.0, 0.0, np.inf])
    place = transform(constraint.point, rotation_z_to(z))
    return [_Row(DISTANCE, tolerance, tolerance, place, half, half)]


def _line_rows(problem: Problem, line: CartesianLine) -> list[_Row]:
    T_start = problem.robot.fk(problem.start, line.frame)
    T_goal = line_end(problem, line)
    displacement, turn = pose_difference(T_start, T_goal)
    length = float(np.linalg.norm(displacement))
    place = transform(
        T_start[:3, 3] + displacement / 2,
        rotation_z_to(displacement / length if length > 0 else np.eye(3)[2]),
    )
    half = np.array([0.0, 0.0, length / 2])
    rows = [_Row(DISTANCE, line.tolerance, line.tolerance, place, half, half)]
    if line.angle is None:
        return rows
    total_angle = float(np.linalg.norm(turn))
    if length < MIN_LINE_LENGTH and total_angle > 0:
        # The link turns in place. Two cones express this: the axis of the turn keeps its direction, and a
        # vector perpendicular to the axis deviates from its direction in mid-turn by at most half the total
        # angle.
        axis = turn / total_angle
        across = rotation_z_to(axis)[:, 0]
        middle = rotation_about(axis, total_angle / 2) @ across
        for link_axis, direction, spread in ((axis, axis, 0.0), (across, middle, total_angle / 2)):
            limit = min(spread + line.angle, np.pi)
            rows.append(_Row(CONE, limit, line.angle, a=T_start[:3, :3].T @ link_axis, b=direction))
    else:
        # gradient · (position - start) is the fraction of the line that is behind the position
        gradient = displacement / length**2 if length > 0 else displacement
        rows.append(_Row(TURN, line.angle, line.angle, T_start, a=turn, b=gradient))
    return rows


def line_end(problem: Problem, line: CartesianLine) -> Pose:
    """The pose T_base_frame of a line's link at the goal. Raises InputError if the goal does not determine
    this pose."""
    robot = problem.robot
    goal = problem.goal
    if isinstance(goal, JointGoal):
        poses = [robot.fk(q, line.frame) for q in goal.positions]
        differences = [inverse(poses[0]) @ T for T in poses[1:]]
        if all(
            np.linalg.norm(T[:3, 3]) < SAME_POSE_TOLERANCE and rotation_angle(T[:3, :3]) < SAME_POSE_TOLERANCE
            for T in differences
        ):
            return poses[0]
        why = f"the {len(poses)} goal configurations put {line.frame} at different poses"
    elif poses := poses_of(goal):
        frames = " and ".join(pose.frame for pose in poses)
        why = f"no pose of the goal, for {frames}, is rigidly connected to {line.frame}"
        for pose in poses:
            if robot.link_frame(pose.frame) == robot.link_frame(line.frame):
                if not pose.tolerant:
                    between = inverse(robot.T_frame_link(pose.frame)) @ robot.T_frame_link(line.frame)
                    return pose.T_base_frame @ between
                why = "the goal has tolerances"
    else:
        why = "the goal is any of several goals"
    raise InputError(
        f"cartesian_line of {line.frame}: the goal must determine the pose of this link, but {why}"
    )


def pose_difference(T_start: Pose, T_end: Pose) -> tuple[Vector, Vector]:
    """The displacement from one pose to another [m], and the axis of the turn times its angle [rad], both in
    the axes of the base; accurate also near half a turn."""
    displacement = T_end[:3, 3] - T_start[:3, 3]
    rotation = T_end[:3, :3] @ T_start[:3, :3].T
    angle = rotation_angle(rotation)
    if angle < 1e-12:
        return displacement, np.zeros(3)
    # R + R^T has the axis as the eigenvector of its largest eigenvalue; R - R^T gives the sign
    axis = np.linalg.eigh(rotation + rotation.T)[1][:, -1]
    skew = rotation[[2, 0, 1], [1, 2, 0]] - rotation[[1, 2, 0], [2, 0, 1]]
    return displacement, angle * axis * (-1.0 if skew @ axis < 0 else 1.0)


def _pose_rows(pose: PoseGoal, position: float, angle: float) -> list[_Row]:
    """Rows for the position and the orientation of a pose.

    position, angle: tolerances of poses that state none [m], [rad].
    """
    T = pose.T_base_frame
    rows = []
    for kind, tolerances, exact in (
        (DISTANCE, pose.xyz_tolerance, position),
        (ROLL_PITCH_YAW, pose.rpy_tolerance, angle),
    ):
        limit = exact if tolerances is None else POSE_TOLERANCE
        half = np.zeros(3) if tolerances is None else (1 - GOAL_MARGIN) * tolerances
        if kind == ROLL_PITCH_YAW:
            half = np.where(half >= (1 - GOAL_MARGIN) * np.pi, np.inf, half)
            if not half.any():
                kind = TURN  # with a = 0: the desired orientation is that of the pose
        rows.append(_Row(kind, limit, limit, T, half, INNER_GOAL_FRACTION * half))
    return rows


def _arrays(robot: Robot, frames: list[str], rows: list[_Row]) -> Rows:
    chains = [robot.chain(frame) for frame in frames]
    joints = np.zeros((len(chains), robot.dof), np.int64)
    for row, chain in zip(joints, chains, strict=True):
        row[: len(chain)] = chain
    kinds = np.array([KINDS[joint.kind] for joint in robot.planned_joints])
    row_fields: dict[str, ndarray] = {
        name: np.array([getattr(row, name) for row in rows]) for name in _Row._fields
    }
    return Rows(
        chain=joints,
        offsets=robot.frame_offsets[joints],
        joint_kinds=kinds[joints],
        continuous=for_kernels(robot.continuous, np.bool_),
        lower=for_kernels(robot.lower),
        upper=for_kernels(robot.upper),
        chain_length=np.array([len(chain) for chain in chains]),
        same_frame=np.array([False, *(a == b for a, b in pairwise(frames))]),
        T_joint_frame=np.stack([robot.T_frame_link(frame) for frame in frames]),
        inner_limit=PROJECTION_FRACTION * row_fields["limit"],
        lever_bounds=np.stack([_lever_bounds(robot, frame) for frame in frames]),
        **row_fields,
    )


def _lever_bounds(robot: Robot, frame: str) -> JointValues:
    """For each joint of a frame's chain, in order, a bound of the distance from its axis to the frame's
    origin [m]; 1 for prismatic joints. Entries after the last joint of the chain are 0."""
    chain = list(robot.chain(frame))
    slides = robot.prismatic[chain]
    # the validator lets joints exceed their limits a little
    travel = np.maximum(np.abs(robot.lower), np.abs(robot.upper))[chain] + 1e-3
    lengths = np.linalg.norm(robot.frame_offsets[chain, :3, 3], axis=1) + np.where(slides, travel, 0.0)
    beyond = np.linalg.norm(robot.T_frame_link(frame)[:3, 3]) + np.cumsum(lengths[::-1])[::-1] - lengths
    out = np.zeros(robot.dof)
    out[: len(chain)] = np.where(slides, 1.0, beyond)
    return out
