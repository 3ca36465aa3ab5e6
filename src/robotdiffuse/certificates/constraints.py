"""Bounds of path constraints from one configuration to the next: the checker's own proof.

Between two configurations joints move by dq at constant rates. A frame's origin p then leaves the chord by at
most an eighth of its second derivative, which is at most sum_jk |dq_j dq_k| L_max(j,k), where L_k bounds the
distance of p from axis k all along. The distance to a convex body is a convex function, so it is bounded by
its greater value at the two ends plus that deviation. An axis of the frame leaves its chord by at most (sum_j
|dq_j|)² / 8, and the angle between two orientations grows no faster than the sum of their rotations.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.certificates.cubics import Cubics, cubics_of
from robotdiffuse.certificates.kinematics import Linkage, Postures, cross_matrix
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Trajectory
from robotdiffuse.problems.constraints import AxisCone, CartesianLine, Constraint, OnPlane, PositionBox
from robotdiffuse.problems.goals import JointGoal, poses_of
from robotdiffuse.problems.problem import Problem

MAX_HALVINGS, MAX_OPEN = 24, 100_000
"""Halvings of a step at most, and stretches at a time, to show that a frame keeps its speed."""
SAME_POSE = 1e-3
"""Poses at several goals may differ by this for a Cartesian line to end there [m] and in entries of R."""


class ConstraintBound(NamedTuple):
    """Upper bounds of one quantity of a constraint."""

    name: str
    limit: float
    """[m] or [rad]"""
    bounds: Float[ndarray, "n"]
    """From each configuration to the next."""


class _Body(NamedTuple):
    """A box whose half sizes may be 0 or infinite along some of its axes."""

    center: ndarray
    R: ndarray
    half: ndarray

    def distances(self, points: ndarray) -> ndarray:
        """Signed distances of points [m], negative inside."""
        beyond = np.abs((points - self.center) @ self.R) - self.half
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


class _FrameMotion(NamedTuple):
    """Motion of a frame from each of n + 1 configurations to the next."""

    p: Float[ndarray, "n1 3"]
    R: Float[ndarray, "n1 3 3"]
    turn: Float[ndarray, "n"]
    """Upper bound of its rotation [rad]."""
    went: Float[ndarray, "n"]
    """Upper bound of the path length of its origin [m]."""
    sag: Float[ndarray, "n"]
    """Upper bound of the origin's distance from the chord [m]."""
    slack: Float[ndarray, "n"]
    """Upper bound of the origin's displacement if every joint is off by 1 rad or 1 m [m]."""
    joints: int
    """Number of joints that move the frame."""


def constraint_bounds(problem: Problem, q: Float[ndarray, "n dof"], chord: float) -> list[ConstraintBound]:
    """Bounds along straight lines through configurations, and along all motions within `chord` of these lines
    in each joint [rad] or [m]. Raises InputError for a Cartesian line if the goal is not a single pose."""
    linkage = Linkage(problem.robot)
    q = q if len(q) > 1 else np.repeat(q, 2, axis=0)
    frames = {constraint.frame for constraint in problem.constraints}
    placed = linkage.place(q, *frames) if len(frames) == 1 else linkage.place(q)
    found = []
    for constraint in problem.constraints:
        along = _frame_motion(linkage, placed, q, constraint.frame)
        name = f"{constraint.kind} of {constraint.frame}"
        if isinstance(constraint, AxisCone):
            cosines = along.R @ constraint.axis @ constraint.direction
            least = np.minimum(cosines[1:], cosines[:-1]) - along.turn**2 / 8
            bounds = np.arccos(np.clip(least, -1.0, 1.0)) + chord * along.joints
            found.append(ConstraintBound(name, constraint.angle, bounds))
            continue
        if isinstance(constraint, CartesianLine):
            T_start, T_goal = _line_poses(problem, linkage, constraint)
            body = _segment(T_start[:3, 3], T_goal[:3, 3])
        else:
            body = _body(constraint)
        limit = 0.0 if isinstance(constraint, PositionBox) else constraint.tolerance
        apart = body.distances(along.p)
        bounds = np.maximum(apart[1:], apart[:-1]) + along.sag + chord * along.slack
        found.append(ConstraintBound(name, limit, bounds))
        if isinstance(constraint, CartesianLine) and constraint.angle is not None:
            bounds = _angle_bounds(along, T_start, T_goal, chord)
            found.append(ConstraintBound(f"{name}, its angle", constraint.angle, bounds))
    return found


def frame_speed_errors(problem: Problem, motion: Trajectory, slack: float) -> list[str]:
    """A line for each frame that is not shown to keep its constraint's speed, but for a share `slack`, along
    the cubics of the motion.

    A velocity leaves its chord by at most an eighth of its second derivative times the square of the time.
    The derivatives of a position by several joints are at most the lever of the last of them.
    """
    linkage, lines, cubics = Linkage(problem.robot), [], cubics_of(motion)
    if cubics is None:
        return lines
    far = np.concatenate([motion.positions, cubics.turns])
    jerks = np.abs(cubics.end - cubics.start) / cubics.steps
    for one in problem.constraints:
        if not isinstance(one, CartesianLine) or one.speed is None:
            continue
        joints, levers = np.flatnonzero(linkage.moved[linkage.links.index(one.frame)]), linkage.levers
        speed, pull = np.cumsum(cubics.speeds[:, joints], axis=1), np.cumsum(cubics.pulls[:, joints], axis=1)
        products = np.diff(3 * pull * speed + speed**3, axis=1, prepend=0.0)
        bends = (jerks[:, joints] + products) @ levers(one.frame, far)
        row, start, stop = np.arange(len(bends)), np.zeros(len(bends)), cubics.steps[:, 0]
        allowed = one.speed * (1 + slack)
        for _ in range(MAX_HALVINGS):
            most = np.maximum(*(_frame_speeds(linkage, cubics, one.frame, row, at) for at in (start, stop)))
            open_ = ~(most + bends[row] * (stop - start) ** 2 / 8 <= allowed)
            if not open_.any() or not (most <= allowed).all() or open_.sum() > MAX_OPEN:
                break
            row, low, high = row[open_], start[open_], stop[open_]
            start, stop = np.append(low, (low + high) / 2), np.append((low + high) / 2, high)
            row = np.tile(row, 2)
        if open_.any():
            how = (
                "is not shown to be slow enough"
                if most.max() <= allowed
                else f"moves at {most.max():.4g} m/s"
            )
            lines.append(f"motion: {one.frame} {how}; {one.speed:g} m/s is allowed")
    return lines


def _frame_speeds(
    linkage: Linkage, cubics: Cubics, frame: str, row: ndarray, time: ndarray
) -> Float[ndarray, "n"]:
    q, v, _ = cubics.at(row, time)
    joints, rates = linkage.rates(linkage.place(q, frame), frame)
    return np.linalg.norm((rates * v[:, joints, None]).sum(axis=1), axis=1)


def _frame_motion(linkage: Linkage, postures: Postures, q: ndarray, frame: str) -> _FrameMotion:
    T, (joints, rates) = postures.T[:, linkage.links.index(frame)], linkage.rates(postures, frame)
    step = np.abs(np.diff(q, axis=0))[:, joints]
    lengths = np.linalg.norm(rates[:-1], axis=2)
    went, sag = np.zeros(len(step)), np.zeros(len(step))
    for j in reversed(range(len(joints))):
        if not linkage.slides[joints[j]]:
            lengths[:, j] += went  # later joints may have moved it away by so much
        went = went + step[:, j] * lengths[:, j]
        before = step[:, :j].sum(axis=1)
        sag += lengths[:, j] * step[:, j] * (step[:, j] + 2 * before) / 8
    turn = step[:, ~linkage.slides[joints]].sum(axis=1)
    return _FrameMotion(T[:, :3, 3], T[:, :3, :3], turn, went, sag, lengths.sum(axis=1), len(joints))


def _body(constraint: Constraint) -> _Body:
    if isinstance(constraint, PositionBox):
        T = constraint.T_base_box
        assert T is not None  # the constructor sees to it
        middle, half = (constraint.low + constraint.high) / 2, (constraint.high - constraint.low) / 2
        return _Body(T[:3, :3] @ middle + T[:3, 3], T[:3, :3], half)
    assert not isinstance(constraint, AxisCone | CartesianLine)
    flat = isinstance(constraint, OnPlane)
    along = constraint.normal if isinstance(constraint, OnPlane) else constraint.direction
    half = np.array([np.inf, np.inf, 0.0] if flat else [0.0, 0.0, np.inf])
    return _Body(constraint.point, _with_z(along), half)


def _segment(start: ndarray, goal: ndarray) -> _Body:
    length = float(np.linalg.norm(goal - start))
    return _Body((start + goal) / 2, _with_z((goal - start) / length), np.array([0.0, 0.0, length / 2]))


def _with_z(z: ndarray) -> Float[ndarray, "3 3"]:
    """A rotation matrix with a given unit vector as its third column."""
    x = np.cross(z, np.eye(3)[int(np.abs(z).argmin())])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _line_poses(problem: Problem, linkage: Linkage, line: CartesianLine) -> tuple[ndarray, ndarray]:
    """T_base_frame at start and goal."""
    k = linkage.links.index(line.frame)
    start, goal = linkage.place(problem.start[None]).T[0], problem.goal
    if isinstance(goal, JointGoal):
        ends = linkage.place(goal.positions).T[:, k]
        if not (np.abs(ends - ends[0]) <= SAME_POSE).all():
            raise InputError(f"cartesian_line of {line.frame}: the goals put it at different poses")
        return start[k], ends[0]
    for pose in poses_of(goal):
        other = linkage.links.index(pose.frame)
        if not pose.tolerant and (linkage.moved[k] == linkage.moved[other]).all():
            return start[k], pose.T_base_frame @ np.linalg.inv(start[other]) @ start[k]
    raise InputError(f"cartesian_line of {line.frame}: the goal does not determine one pose of it")


def _angle_bounds(along: _FrameMotion, T_start: ndarray, T_goal: ndarray, chord: float) -> ndarray:
    """Bounds of the angle between the frame's orientation and the one interpolated at its place on the
    line."""
    way = T_goal[:3, 3] - T_start[:3, 3]
    length = float(np.linalg.norm(way))
    turn = _rotation_vector(T_goal[:3, :3] @ T_start[:3, :3].T)
    whole = float(np.linalg.norm(turn))
    share = np.clip((along.p - T_start[:3, 3]) @ way / length**2, 0.0, 1.0)
    axis = turn / whole if whole > 0 else np.array([0.0, 0.0, 1.0])
    K = cross_matrix(axis)
    angles = (share * whole)[:, None, None]
    wanted = (np.eye(3) + np.sin(angles) * K + (1 - np.cos(angles)) * (K @ K)) @ T_start[:3, :3]
    # from the norm of the difference of rotations, which is accurate near 0 too
    chords = np.linalg.norm(along.R - wanted, axis=(1, 2))
    off = 2 * np.arcsin(np.clip(chords / np.sqrt(8), 0.0, 1.0))
    reach = whole / length
    return (off[1:] + off[:-1] + along.turn + reach * along.went) / 2 + chord * (
        along.joints + reach * along.slack
    )


def _rotation_vector(R: ndarray) -> ndarray:
    angle = 2 * np.arcsin(np.clip(np.linalg.norm(R - np.eye(3)) / np.sqrt(8), 0.0, 1.0))
    if angle < 1e-12:
        return np.zeros(3)
    axis = np.linalg.eigh(R + R.T)[1][:, -1]
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return angle * axis * (-1.0 if skew @ axis < 0 else 1.0)
