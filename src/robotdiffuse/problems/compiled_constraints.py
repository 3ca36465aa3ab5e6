"""The path constraints of a problem, made ready: what they say of configurations, and proofs of motions."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import inverse, rotation_angle, rotation_z_to, transform
from robotdiffuse.problems import constraint_kernel as kernel
from robotdiffuse.problems.constraint_kernel import CONE, DISTANCE, TURN, Rows
from robotdiffuse.problems.constraints import (
    AxisCone,
    CartesianLine,
    Constraint,
    OnPlane,
    PositionBox,
)
from robotdiffuse.problems.goals import JointGoal, PoseGoal, poses_of
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.inverse_kinematics import KINDS
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot

FINEST = 1e-7
"""Share of a segment down to which a proof splits it."""
EPISODE_STEP, EPISODE_STEPS = 0.01, 1000
"""Step [rad] and number of the configurations at which the greatest excess is looked for."""
INNER = 0.5
"""Share of a tolerance that projection goes to."""
EXACT = 2e-6
"""What a projected link may be off its pose [m], [rad]."""
SHORTEST = 1e-3
"""A Cartesian line is at least so long [m]."""
ONE_POSE = 1e-3
"""Goal configurations may put the frame of a line at most so far apart [m], [rad]."""


@dataclass(frozen=True)
class Excess:
    """Where a motion first is not proved to keep a constraint."""

    constraint: Constraint
    at: float
    """Waypoint index plus fraction."""
    value: float
    """The greatest value until it is kept again [m] or [rad]."""
    limit: float
    angular: bool

    @property
    def excess(self) -> float:
        """Beyond the limit; 0 where it was only not proved to be kept."""
        return max(self.value - self.limit, 0.0)

    @property
    def message(self) -> str:
        """Which constraint and by how much, in words."""
        name = f"{self.constraint.kind} of {self.constraint.frame}"
        unit, scale = ("degrees", np.degrees(1.0)) if self.angular else ("mm", 1e3)
        if self.excess == 0.0:
            return f"{name} cannot be proved to be kept: the motion comes within rounding of its limit"
        if self.limit <= 0.0:
            return f"{name} is left by {scale * self.excess:.3g} {unit}"
        return f"{name} is exceeded: {scale * self.value:.4g} {unit}, of {scale * self.limit:.4g} allowed"


class _Row(NamedTuple):
    """Of `Rows`, for one frame."""

    what: int
    limit: float
    room: float
    place: ndarray = np.eye(4)
    half: ndarray = np.zeros(3)
    core: ndarray = np.zeros(3)
    a: ndarray = np.zeros(3)
    b: ndarray = np.zeros(3)


class PathConstraints:
    """Rows of all constraints of a problem."""

    def __init__(self, problem: Problem, poses: Sequence[PoseGoal] = ()) -> None:
        """`poses`: beside them, links that are to be at these very poses, for projection.

        Raises InputError where a Cartesian line has no ends.
        """
        self.robot = problem.robot
        each = [(constraint, row) for constraint in problem.constraints for row in _rows(problem, constraint)]
        self.owners = [constraint for constraint, _ in each]
        """The constraint of each row."""
        at = [(pose.frame, row) for pose in poses for row in _pose_rows(pose)]
        frames = [owner.frame for owner in self.owners] + [frame for frame, _ in at]
        self.rows = _arrays(problem.robot, frames, [row for _, row in each + at])
        self._paced = [
            (m, owner.speed)
            for m, owner in enumerate(self.owners)
            if isinstance(owner, CartesianLine) and owner.speed is not None and each[m][1].what == DISTANCE
        ]

    def values(self, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n rows"]:
        """Of each row [m] or [rad]."""
        return kernel.values(self.rows, for_kernels(q))

    def limits(self, share: float) -> Float[ndarray, "rows"]:
        """Of the values, with a share of the tolerances [m] or [rad]."""
        return self.rows.limit - (1 - share) * self.rows.room

    def kept(self, q: Float[ndarray, "n dof"], share: float = 1.0) -> Bool[ndarray, "n"]:
        """Which configurations keep all constraints; with less than a share of 1, and room beside."""
        return np.all(self.values(q) <= self.limits(share), axis=1)

    def projected(self, q: Float[ndarray, "n dof"], share: float) -> Float[ndarray, "k dof"]:
        """Configurations near those given that keep a share of the tolerances, of each that leads to one."""
        limits, work = self.limits(share), kernel.make_work(self.rows)
        rows = [row for row in q.astype(np.float64) if kernel.project(self.rows, limits, row, work)]
        return np.stack(rows) if rows else np.zeros((0, self.robot.dof))

    def worst(self, q: Float[ndarray, "dof"]) -> Excess | None:
        """The constraint that a configuration exceeds most, by its room; None if it keeps all."""
        [values] = self.values(q[None])
        over = (values - self.rows.limit) / self.rows.room
        row = int(over.argmax())
        return self._excess(row, 0.0, float(values[row])) if over[row] > 0 else None

    def first(self, q: Float[ndarray, "n dof"], chord: float = 0.0, share: float = 1.0) -> Excess | None:
        """Where the straight lines through waypoints first are not proved to keep the constraints; None if
        they are proved to all along.

        chord: what the motion may leave them by, each joint [rad] or [m], is taken from the limits.
        share: of their tolerances, which are taken whole.
        """
        q, rows = for_kernels(q), self.rows
        around = np.where(rows.what == DISTANCE, rows.reach.sum(axis=1), rows.last)
        turning = (rows.what == TURN) * np.linalg.norm(rows.a, axis=1) * np.linalg.norm(rows.b, axis=1)
        slack = chord * (around + turning * rows.reach.sum(axis=1))
        limits = self.limits(share) - slack
        segment, part, row = kernel.first_unproved(rows, limits, q, FINEST)
        if row < 0:
            return None
        return self._excess(row, segment + part, self._greatest(q, segment, part, row))

    def speeds(self, q: Float[ndarray, "n dof"], rates: Float[ndarray, "n dof"]) -> Float[ndarray, "n paced"]:
        """Speeds of the frames that have a greatest one [m/s], one column each, for rates of the joints."""
        columns = [kernel.speeds(self.rows, m, for_kernels(q), for_kernels(rates)) for m, _ in self._paced]
        return np.stack(columns, axis=1) if columns else np.zeros((len(q), 0))

    @property
    def most_speeds(self) -> Float[ndarray, "paced"]:
        """Greatest speeds of those frames [m/s]."""
        return np.array([speed for _, speed in self._paced])

    @property
    def paced(self) -> list[Constraint]:
        """The constraints that they are of."""
        return [self.owners[m] for m, _ in self._paced]

    def _greatest(self, q: ndarray, segment: int, part: float, row: int) -> float:
        """The greatest value of a row from a place on, until it is kept again."""
        following = min(segment + 1, len(q) - 1)
        at = q[segment] + part * (q[following] - q[segment])
        way = np.concatenate([at[None], q[following:]])
        lengths = np.linalg.norm(np.diff(way, axis=0), axis=1)
        knots = np.concatenate([[0.0], np.cumsum(lengths)])
        near = np.geomspace(FINEST, EPISODE_STEP, 64)
        s = np.unique(np.concatenate([near, EPISODE_STEP * np.arange(EPISODE_STEPS), knots]))
        s = s[s <= min(knots[-1], EPISODE_STEP * EPISODE_STEPS)]
        places = np.stack([np.interp(s, knots, column) for column in way.T], axis=1)
        values = self.values(places)[:, row]
        over = values > self.rows.limit[row]
        begun = int(over.argmax())
        back = np.flatnonzero(~over[begun:])
        return float(values[: begun + (back[0] if len(back) and over[begun] else len(values))].max())

    def _excess(self, row: int, at: float, value: float) -> Excess:
        limit, angular = float(self.rows.limit[row]), bool(self.rows.what[row] != DISTANCE)
        return Excess(self.owners[row], at, value, limit, angular)


def _rows(problem: Problem, constraint: Constraint) -> list[_Row]:
    if isinstance(constraint, AxisCone):
        angle = constraint.angle
        return [_Row(CONE, angle, angle, a=constraint.axis, b=constraint.direction)]
    if isinstance(constraint, PositionBox):
        half, T = (constraint.high - constraint.low) / 2, constraint.T_base_box
        assert T is not None  # the constructor sees to it
        place = T @ transform((constraint.high + constraint.low) / 2)
        room = float(half.min())
        return [_Row(DISTANCE, 0.0, room, place, half, half - INNER * room)]
    tolerance = constraint.tolerance
    if isinstance(constraint, CartesianLine):
        return _line_rows(problem, constraint)
    along = constraint.normal if isinstance(constraint, OnPlane) else constraint.direction
    flat = [np.inf, np.inf, 0.0] if isinstance(constraint, OnPlane) else [0.0, 0.0, np.inf]
    place, half = transform(constraint.point, rotation_z_to(along)), np.array(flat)
    return [_Row(DISTANCE, tolerance, tolerance, place, half, half)]


def _line_rows(problem: Problem, line: CartesianLine) -> list[_Row]:
    T_start, T_goal = link_pose(problem.robot, problem.start, line.frame), line_end(problem, line)
    way = T_goal[:3, 3] - T_start[:3, 3]
    length = float(np.linalg.norm(way))
    if length < SHORTEST:
        raise InputError(
            f"cartesian_line: {line.frame} is {1e3 * length:.2g} mm from where the goal has it; a line is at "
            f"least {1e3 * SHORTEST:g} mm long"
        )
    place = transform(T_start[:3, 3] + way / 2, rotation_z_to(way / length))
    half = np.array([0.0, 0.0, length / 2])
    rows = [_Row(DISTANCE, line.tolerance, line.tolerance, place, half, half)]
    if line.angle is not None:
        turn = _rotation_vector(T_goal[:3, :3] @ T_start[:3, :3].T)
        rows.append(_Row(TURN, line.angle, line.angle, T_start, a=turn, b=way / length**2))
    return rows


def line_end(problem: Problem, line: CartesianLine) -> Float[ndarray, "4 4"]:
    """T_base_frame where the goal has the frame of a line; InputError where it does not say one pose."""
    robot, goal = problem.robot, problem.goal
    if isinstance(goal, JointGoal):
        poses = [link_pose(robot, q, line.frame) for q in goal.positions]
        off = [inverse(poses[0]) @ T for T in poses[1:]]
        if all(np.linalg.norm(T[:3, 3]) < ONE_POSE and rotation_angle(T[:3, :3]) < ONE_POSE for T in off):
            return poses[0]
        why = f"its {len(poses)} configurations have {line.frame} at different poses"
    elif poses := poses_of(goal):
        for pose in poses:
            if robot.link_frame(pose.frame) == robot.link_frame(line.frame) and not pose.tolerant:
                between = inverse(robot.T_frame_link(pose.frame)) @ robot.T_frame_link(line.frame)
                return pose.T_base_frame @ between
        what = " and of ".join(pose.frame for pose in poses)
        why = f"it is a pose of {what}, which does not move with {line.frame}"
        if any(robot.link_frame(pose.frame) == robot.link_frame(line.frame) for pose in poses):
            why = "it leaves room"
    else:
        why = "it is any of several"
    raise InputError(f"cartesian_line of {line.frame}: the goal must say one pose of it, but {why}")


def _rotation_vector(rotation: Float[ndarray, "3 3"]) -> Float[ndarray, "3"]:
    """Axis times angle, also near half a turn."""
    angle = rotation_angle(rotation)
    if angle < 1e-12:
        return np.zeros(3)
    # the axis is the eigenvector of eigenvalue 1, its sign that of the skew part
    axis = np.linalg.eigh(rotation + rotation.T)[1][:, -1]
    skew = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0]])
    skew = np.append(skew, rotation[1, 0] - rotation[0, 1])
    return angle * axis * (-1.0 if skew @ axis < 0 else 1.0)


def _pose_rows(pose: PoseGoal) -> list[_Row]:
    """Position and orientation, without their tolerances."""
    T, nothing = pose.T_base_frame, np.zeros(3)
    return [_Row(what, EXACT, EXACT, T, nothing, nothing) for what in (DISTANCE, TURN)]


def _arrays(robot: Robot, frames: list[str], rows: list[_Row]) -> Rows:
    chains = [robot.chain(frame) for frame in frames]
    joints = np.zeros((len(chains), robot.dof), np.int64)
    for row, chain in zip(joints, chains, strict=True):
        row[: len(chain)] = chain
    kinds = np.array([KINDS[joint.kind] for joint in robot.planned_joints])
    tools = [robot.T_frame_link(frame) for frame in frames]
    return Rows(
        joints=joints,
        offsets=robot.frame_offsets[joints],
        kinds=kinds[joints],
        endless=for_kernels(robot.continuous, np.bool_),
        lower=for_kernels(robot.lower),
        upper=for_kernels(robot.upper),
        what=np.array([row.what for row in rows]),
        last=np.array([len(chain) for chain in chains]),
        again=np.array([False, *(a == b for a, b in pairwise(frames))]),
        tool=np.stack(tools),
        place=np.stack([row.place for row in rows]),
        half=np.stack([row.half for row in rows]),
        core=np.stack([row.core for row in rows]),
        a=np.stack([row.a for row in rows]),
        b=np.stack([row.b for row in rows]),
        limit=np.array([row.limit for row in rows]),
        inner=np.array([INNER * row.limit for row in rows]),
        room=np.array([row.room for row in rows]),
        reach=np.stack([_reach(robot, frame) for frame in frames]),
    )


def _reach(robot: Robot, frame: str) -> Float[ndarray, "dof"]:
    """Bounds of the distance from the axis of each joint that moves a frame to its origin [m], in order; 1
    for prismatic joints, 0 after the last one."""
    out, length = np.zeros(robot.dof), float(np.linalg.norm(robot.T_frame_link(frame)[:3, 3]))
    for i, k in reversed([*enumerate(robot.chain(frame))]):
        joint = robot.planned_joints[k]
        if robot.prismatic[k]:
            out[i] = 1.0
            length += max(abs(joint.lower), abs(joint.upper)) + 1e-3
        else:
            out[i] = length
        length += float(np.linalg.norm(robot.frame_offsets[k, :3, 3]))
    return out
