"""Tests by which the checker of certificates proves every requirement except freedom from collision: limits,
start, goal, rates, path constraints and torques. They are independent of the validator.

Path constraints: from one configuration to the next, each joint j moves by dq_j at a constant rate. The
origin p of a frame then deviates from the chord (the straight line between its two positions) by at most an
eighth of its largest second derivative. This derivative is at most sum_jk |dq_j dq_k| L_m with m = max(j, k),
where L_m is an upper bound on the distance of p from the axis of joint m during the motion. A constraint
keeps p in a convex set. The distance to such a set is a convex function. So along the chord, this distance is
at most the larger of its values at the two ends; the deviation is added. An axis of the frame deviates from
its own chord by at most (sum_j |dq_j|)² / 8. On a Cartesian line, the angle between the frame and its
interpolated orientation changes no faster than the sum of their speeds of rotation.

Torques are computed at samples: the rows of the motion and places between them. Between two samples,
positions follow a cubic or a straight line, and velocities and accelerations are its derivatives.
Accelerations may jump at rows. A torque deviates from linear interpolation by at most an eighth of its
largest second derivative times the square of the interval. Torques are sums and products of vectors that
rotate with the links. So the product rule bounds the second derivative by bounds on the motion of links and
joints.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.certificates.kinematics import (
    Cubics,
    Linkage,
    Postures,
    clock,
    cubics_of,
    places_of,
)
from robotdiffuse.certificates.proof import BOUND_TOLERANCE, MotionProof, Tolerances
from robotdiffuse.core.errors import InputError, joined
from robotdiffuse.core.transforms import rotation_about, rotation_z_to
from robotdiffuse.core.types import (
    Configurations,
    JointRows,
    JointValues,
    Mask,
    Path,
    Points,
    Pose,
    Rotation,
    Trajectory,
    Values,
    Vector,
    interpolated,
    step_lengths,
)
from robotdiffuse.problems.constraints import AxisCone, CartesianLine, Constraint, OnPlane, PositionBox
from robotdiffuse.problems.problem import AnyGoal, Goal, JointGoal, PosesGoal, Problem, poses_of
from robotdiffuse.robots.bodies import Inertia
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import Robot

# To prove a frame's speed limit, intervals are halved at most MAX_HALVINGS times; at most MAX_OPEN are halved
# at once.
MAX_HALVINGS = 24
MAX_OPEN = 100_000
MIN_LINE_LENGTH = 1e-3
"""On a Cartesian line shorter than this, the frame counts as rotating in place [m]."""
SAME_POSE = 1e-3
"""Goal poses with differences up to this, in position [m] and entries of the rotation matrix, are the same
end of a Cartesian line."""


class _FrameMotion(NamedTuple):
    """Motion of a frame from each of n + 1 configurations to the next."""

    p: Points
    """Position of the frame's origin at each configuration [m]."""
    R: ndarray
    """Rotation of the frame at each configuration."""
    turn: Values
    """Upper bound of the angle by which the frame rotates, for each of the n steps [rad]."""
    travel: Values
    """Upper bound of the path length of its origin in each step [m]."""
    deviation: Values
    """Upper bound of the origin's distance from the chord in each step [m]."""
    sensitivity: Values
    """Upper bound of the origin's displacement if every joint is displaced by 1 rad or 1 m [m]."""
    joints: int
    """Number of joints that move the frame."""


def constraint_bounds(
    problem: Problem, q: Configurations, chord: float
) -> tuple[Sequence[str], Float[ndarray, "n b"], Sequence[float]]:
    """The quantities that path constraints limit, such as a distance or an angle: the name of each, upper
    bounds from each configuration to the next, and its largest allowed value [m] or [rad].

    The bounds hold for every motion in which each joint leaves its straight line by at most `chord` [rad] or
    [m]. Raises InputError for a Cartesian line if the goal is not a single pose.
    """
    linkage = Linkage(problem.robot)
    q = q if len(q) > 1 else np.repeat(q, 2, axis=0)
    postures = linkage.place(q)
    quantities = list[tuple[str, Values, float]]()
    for constraint in problem.constraints:
        motion = _frame_motion(linkage, postures, q, constraint.frame)
        name = f"{constraint.kind} of {constraint.frame}"
        if isinstance(constraint, AxisCone):
            cosines = motion.R @ constraint.axis @ constraint.direction
            min_cosine = np.minimum(cosines[1:], cosines[:-1]) - motion.turn**2 / 8
            bounds = np.arccos(np.clip(min_cosine, -1.0, 1.0)) + chord * motion.joints
            quantities.append((name, bounds, constraint.angle))
            continue
        ends = _line_poses(problem, linkage, constraint) if isinstance(constraint, CartesianLine) else ()
        distances_to_box = _distances(motion.p, *_allowed_box(constraint, *ends))
        bounds = (
            np.maximum(distances_to_box[1:], distances_to_box[:-1])
            + motion.deviation
            + chord * motion.sensitivity
        )
        limit = 0.0 if isinstance(constraint, PositionBox) else constraint.tolerance
        quantities.append((name, bounds, limit))
        if isinstance(constraint, CartesianLine) and constraint.angle is not None:
            bounds = _angle_bounds(motion, chord, *ends)
            quantities.append((f"{name}, its angle", bounds, constraint.angle))
    names, columns, limits = zip(*quantities, strict=True)
    return names, np.column_stack(columns), limits


def frame_speed_errors(problem: Problem, motion: Trajectory, slack: float) -> Iterator[str]:
    """A message for each frame that is not proved to keep its constraint's speed limit along the cubics. The
    limit may be exceeded by the fraction `slack`.

    A velocity deviates from linear interpolation by at most an eighth of its largest second derivative times
    the square of the interval. The derivative of a position with respect to several joints is at most the
    lever arm of the last of these joints.
    """
    linkage = Linkage(problem.robot)
    cubics = cubics_of(motion)
    extreme_positions = np.concatenate([motion.positions, cubics.turning_points])
    for constraint in problem.constraints:
        if not isinstance(constraint, CartesianLine) or constraint.speed is None:
            continue
        joints = np.flatnonzero(linkage.moved[linkage.links.index(constraint.frame)])
        speed = np.cumsum(cubics.speeds[:, joints], axis=1)
        acceleration = np.cumsum(cubics.peak_accelerations[:, joints], axis=1)
        products = np.diff(3 * acceleration * speed + speed**3, axis=1, prepend=0.0)
        second_derivatives = (cubics.jerks[:, joints] + products) @ linkage.levers(
            constraint.frame, extreme_positions
        )
        row = np.arange(len(second_derivatives))
        start = np.zeros(len(second_derivatives))
        stop = cubics.steps[:, 0]
        allowed = constraint.speed * (1 + slack)
        for _ in range(MAX_HALVINGS):
            max_speeds = np.maximum(
                *(_frame_speeds(linkage, cubics, constraint.frame, row, at) for at in (start, stop))
            )
            undecided = ~(max_speeds + second_derivatives[row] * (stop - start) ** 2 / 8 <= allowed)
            if not undecided.any() or not (max_speeds <= allowed).all() or undecided.sum() > MAX_OPEN:
                break
            row = row[undecided]
            low = start[undecided]
            high = stop[undecided]
            start = np.append(low, (low + high) / 2)
            stop = np.append((low + high) / 2, high)
            row = np.tile(row, 2)
        if undecided.any():
            finding = (
                "is not shown to be slow enough"
                if max_speeds.max() <= allowed
                else f"moves at {max_speeds.max():.4g} m/s"
            )
            yield f"motion: {constraint.frame} {finding}; {constraint.speed:g} m/s is allowed"


def _frame_speeds(linkage: Linkage, cubics: Cubics, frame: str, row: ndarray, time: ndarray) -> Values:
    q, v, _ = cubics.at(row, time)
    joints, rates = linkage.rates(linkage.place(q), frame)
    return np.linalg.norm((rates * v[:, joints, None]).sum(axis=1), axis=1)


def _frame_motion(linkage: Linkage, postures: Postures, q: ndarray, frame: str) -> _FrameMotion:
    T, (joints, rates) = postures.T[:, linkage.links.index(frame)], linkage.rates(postures, frame)
    step = np.abs(np.diff(q, axis=0))[:, joints]
    lengths = np.linalg.norm(rates[:-1], axis=2)
    travel = np.zeros(len(step))
    deviation = np.zeros(len(step))
    for j in reversed(range(len(joints))):
        if not linkage.slides[joints[j]]:
            lengths[:, j] += travel  # later joints may have moved the origin this far from the axis
        travel = travel + step[:, j] * lengths[:, j]
        before = step[:, :j].sum(axis=1)
        deviation += lengths[:, j] * step[:, j] * (step[:, j] + 2 * before) / 8
    turn = step[:, ~linkage.slides[joints]].sum(axis=1)
    return _FrameMotion(T[:, :3, 3], T[:, :3, :3], turn, travel, deviation, lengths.sum(axis=1), len(joints))


def _allowed_box(constraint: Constraint, *ends: Pose) -> tuple[Vector, Rotation, Vector]:
    """The box in which a constraint keeps a frame's origin: center, rotation and half sizes, which may be 0
    or infinite. ends: start and goal pose of a Cartesian line."""
    if isinstance(constraint, PositionBox):
        T = constraint.T_base_box
        assert T is not None  # ensured by the constructor
        middle = (constraint.low + constraint.high) / 2
        return T[:3, :3] @ middle + T[:3, 3], T[:3, :3], (constraint.high - constraint.low) / 2
    if isinstance(constraint, CartesianLine):
        start, goal = (T[:3, 3] for T in ends)
        length = float(np.linalg.norm(goal - start))
        along = (goal - start) / length if length > 0 else np.array([0.0, 0.0, 1.0])
        return (start + goal) / 2, rotation_z_to(along), np.array([0.0, 0.0, length / 2])
    assert not isinstance(constraint, AxisCone)
    if isinstance(constraint, OnPlane):
        return constraint.point, rotation_z_to(constraint.normal), np.array([np.inf, np.inf, 0.0])
    return constraint.point, rotation_z_to(constraint.direction), np.array([0.0, 0.0, np.inf])


def _distances(points: Points, center: Vector, R: Rotation, half: Vector) -> Values:
    """Signed distances of points to a box [m], negative inside."""
    beyond = np.abs((points - center) @ R) - half
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def _line_poses(problem: Problem, linkage: Linkage, line: CartesianLine) -> tuple[Pose, Pose]:
    """T_base_frame at the start and at the goal of a Cartesian line. Raises InputError if the goal does not
    determine one pose."""
    k = linkage.links.index(line.frame)
    start = linkage.place(problem.start[None]).T[0]
    goal = problem.goal
    if isinstance(goal, JointGoal):
        ends = linkage.place(goal.positions).T[:, k]
        if not (np.abs(ends - ends[0]) <= SAME_POSE).all():
            raise InputError(f"cartesian_line of {line.frame}: the goals put it at different poses")
        return start[k], ends[0]
    for pose in poses_of(goal):
        goal_link = linkage.links.index(pose.frame)
        if not pose.tolerant and (linkage.moved[k] == linkage.moved[goal_link]).all():
            return start[k], pose.T_base_frame @ np.linalg.inv(start[goal_link]) @ start[k]
    raise InputError(f"cartesian_line of {line.frame}: the goal does not determine one pose of it")


def _angle_bounds(motion: _FrameMotion, chord: float, *ends: Pose) -> Values:
    """Upper bounds, for each step, on the angle between the frame's orientation and the orientation that is
    interpolated for its position on the line."""
    T_start, T_goal = ends
    R_start = T_start[:3, :3]
    displacement = T_goal[:3, 3] - T_start[:3, 3]
    length = float(np.linalg.norm(displacement))
    turn = T_goal[:3, :3] @ R_start.T
    total_angle = float(_angles(turn[None], np.eye(3))[0])
    axis = np.linalg.eigh(turn + turn.T)[1][:, -1]
    axis = axis if _skew(turn) @ axis >= 0 else -axis  # an eigenvector's sign is arbitrary
    if length < MIN_LINE_LENGTH:  # rotation in place: the nearest orientation between start and goal
        turned = motion.R @ R_start.T
        cosines = np.trace(turned, axis1=1, axis2=2) - turned @ axis @ axis
        angles = np.clip(np.arctan2(_skew(turned) @ axis, cosines), 0.0, total_angle)
        angle_per_length = 0.0
    else:
        fraction = np.clip((motion.p - T_start[:3, 3]) @ displacement / length**2, 0.0, 1.0)
        angles = fraction * total_angle
        angle_per_length = total_angle / length
    target_rotations = rotation_about(axis, angles[:, None, None]) @ R_start
    errors = _angles(motion.R, target_rotations)
    return (errors[1:] + errors[:-1] + motion.turn + angle_per_length * motion.travel) / 2 + chord * (
        motion.joints + angle_per_length * motion.sensitivity
    )


def _skew(R: Float[ndarray, "*n 3 3"]) -> Float[ndarray, "*n 3"]:
    """The axis of each rotation, times twice the sine of its angle."""
    return R[..., [2, 0, 1], [1, 2, 0]] - R[..., [1, 2, 0], [2, 0, 1]]


def _angles(first: ndarray, second: ndarray) -> Values:
    """Angles between rotations [rad], from the norm of their difference, which is accurate near 0 too."""
    return 2 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=(1, 2)) / np.sqrt(8), 0.0, 1.0))


GRAVITY = 9.81
"""Gravitational acceleration along -z of the world [m/s²]."""
MIN_MASS = 1e-9
"""A payload with a smaller mass is ignored [kg]."""


Bound = Float[ndarray, "3 m"]
"""Upper bounds on the norm of a vector, or on a number, and on its first two derivatives, over m
intervals."""


def _product(factor: ndarray, other: ndarray) -> ndarray:
    """The `Bound` of a product, by the product rule."""
    size, first, second = other
    second_derivative = factor[2] * size + 2 * factor[1] * first + factor[0] * second
    return np.stack([factor[0] * size, factor[1] * size + factor[0] * first, second_derivative])


def torque_bounds(problem: Problem, motion: Path | Trajectory, samples: Values) -> JointRows:
    """Upper bounds of each joint's absolute torque from each sample to the next [N m] or [N].

    Torques are computed at the rows and at `samples` between them: times, or for a path the index of a row
    plus the fraction of the way to the next row.
    """
    ends, durations, bounds = _intervals(motion, samples)
    torques = np.abs([inverse_dynamics(problem, *end) for end in ends]).max(axis=0)
    return torques + _second_derivative_bounds(problem, bounds) * durations[:, None] ** 2 / 8


def _intervals(motion: Path | Trajectory, samples: Values) -> tuple[ndarray, Values, ndarray]:
    """The m intervals between consecutive samples of a motion.

    Returns positions, velocities and accelerations at the start and the end of each interval [2, 3, m, dof];
    durations [s], 1 for a path; and the `Bound` of the positions, velocities and accelerations
    [3, 3, m, dof]. Derivatives are by time. A path has no times: its velocities and accelerations are 0, and
    derivatives are by the fraction of the interval.
    """
    cubics = cubics_of(motion)
    if isinstance(motion, Path) or not len(cubics.times):
        q = configurations(motion, samples)
        q = np.repeat(q, 2, axis=0) if len(q) == 1 else q
        ends = np.zeros((2, 3, *q[1:].shape))
        ends[:, 0] = q[:-1], q[1:]
        bounds = np.zeros((3, *ends[0].shape))
        bounds[0, :2] = np.abs(ends[:, 0]).max(axis=0), np.abs(np.diff(q, axis=0))
        return ends, np.ones(len(q) - 1), bounds
    at = places_of(motion, samples)
    row = cubics.rows(at[:-1])
    ends = np.array([cubics.at(row, time - cubics.times[row]) for time in (at[:-1], at[1:])])
    far = np.abs(cubics.positions) + cubics.speeds * cubics.steps
    rates = [far, cubics.speeds, cubics.peak_accelerations, cubics.jerks, 0 * far]
    return ends, np.diff(at), np.array([rates[k : k + 3] for k in range(3)])[:, :, row]


def inverse_dynamics(problem: Problem, q: Configurations, v: JointRows, a: JointRows) -> JointRows:
    """Torques [n, dof] by the Newton-Euler equations of each link, in the base frame [N m] or [N]."""
    linkage = Linkage(problem.robot)
    postures = linkage.place(q)
    T = {link: postures.T[:, k] for k, link in enumerate(linkage.links)}
    up = np.eye(4)[2, :3] if problem.T_world_base is None else problem.T_world_base[2, :3]
    still = np.zeros((len(q), 3))

    def of_joint(joint: Joint, j: int | None, rotation: None) -> tuple[Any, ...]:
        arm = T[joint.child][:, :3, 3] - T[joint.parent][:, :3, 3]
        if j is None:
            return arm, None, None, None, rotation
        axis = postures.axes[:, j]
        return arm, axis, v[:, j, None] * axis, a[:, j, None] * axis, rotation

    def of_body(body: Inertia, link: str, _: None) -> tuple[ndarray, Callable[[ndarray], ndarray]]:
        R = T[link][:, :3, :3]
        inertia = R @ body.moments @ R.transpose(0, 2, 1)
        return R @ body.com, lambda w: np.einsum("nij,nj->ni", inertia, w)

    at_base = None, still, still, still + GRAVITY * up
    loads = _newton_euler(problem, at_base, of_joint, of_body, np.cross)
    return np.stack([(axis * load).sum(axis=1) for axis, load in loads], axis=1)


def _newton_euler(
    problem: Problem,
    at_base: tuple[Any, ...],
    of_joint: Callable[[Joint, int | None, Any], tuple[Any, ...]],
    of_body: Callable[[Inertia, str, Any], tuple[ndarray, Callable[[ndarray], ndarray]]],
    cross: Callable[[ndarray, ndarray], ndarray],
) -> list[tuple[ndarray, ndarray]]:
    """The axis of each planned joint, and the force or moment on it: vectors, or the `Bound` of each.

    at_base: the motion of the base: its rotation as `of_joint` and `of_body` need it, its angular velocity,
        which is 0, its angular acceleration, and the acceleration of its origin, opposite to gravity.
    of_joint: takes a joint, its index (None if it is not planned) and the rotation of the parent link.
        Returns five values: the vector from the parent's origin to the child's, the axis, the joint's
        velocity and acceleration along it, and the child link's rotation. For a joint that is not planned,
        axis, velocity and acceleration are None.
    of_body: takes a body, its link and the link's rotation. Returns the vector to the center of mass, and a
        function that multiplies a vector by the inertia.
    cross: the cross product.
    """
    robot = problem.robot
    number = {joint.name: j for j, joint in enumerate(robot.planned_joints)}
    slides = Linkage(robot).slides
    link_motion = {robot.base: at_base}
    arms = dict[str, ndarray]()
    axes = dict[str, ndarray]()
    for joint in robot.joints:
        j = number.get(joint.name)
        link = joint.child
        rotation, w, dw, acceleration = link_motion[joint.parent]
        arms[link], axes[link], joint_velocity, joint_acceleration, rotation = of_joint(joint, j, rotation)
        acceleration = acceleration + cross(dw, arms[link]) + cross(w, cross(w, arms[link]))
        if j is not None and slides[j]:
            acceleration = acceleration + joint_acceleration + 2.0 * cross(w, joint_velocity)
        elif j is not None:
            w, dw = w + joint_velocity, dw + joint_acceleration + cross(w, joint_velocity)
        link_motion[link] = rotation, w, dw, acceleration
    carried = _link_inertias(problem)
    force, moment = ({link: at_base[1] for link in link_motion} for _ in range(2))
    loads = {}
    for joint in reversed(robot.joints):
        j = number.get(joint.name)
        link = joint.child
        rotation, w, dw, acceleration = link_motion[link]
        for body in carried.get(link, ()):
            arm, inertia = of_body(body, link, rotation)
            body_force = body.mass * (acceleration + cross(dw, arm) + cross(w, cross(w, arm)))
            force[link] = force[link] + body_force
            moment[link] = moment[link] + inertia(dw) + cross(w, inertia(w)) + cross(arm, body_force)
        if j is not None:
            loads[j] = axes[link], force[link] if slides[j] else moment[link]
        force[joint.parent] = force[joint.parent] + force[link]
        moment[joint.parent] = moment[joint.parent] + moment[link] + cross(arms[link], force[link])
    return [loads[j] for j in range(len(number))]


def _second_derivative_bounds(problem: Problem, bounds: ndarray) -> JointRows:
    """Upper bounds on the second derivatives of torques from each sample to the next, by the Newton-Euler
    equations with a `Bound` in place of each vector, and the `Bound` of a link's angular velocity in place
    of its rotation."""
    robot = problem.robot
    still = np.zeros((3, bounds.shape[2]))
    slides = Linkage(robot).slides

    def of_joint(joint: Joint, j: int | None, rotation: Bound) -> tuple[Any, ...]:
        fixed_motion = joint.motion(robot.locked.get(joint.name, 0.0)) if j is None else np.eye(4)
        arm = _rotating(float(np.linalg.norm((joint.T_parent_joint @ fixed_motion)[:3, 3])), rotation)
        if j is None:
            return arm, None, None, None, rotation
        axis = _rotating(1.0, rotation)
        position, velocity, acceleration = bounds[..., j]
        if slides[j]:
            arm = arm + _product(position, axis)
        else:
            rotation = rotation + _product(np.stack([*position[1:], still[0]]), axis)
        return arm, axis, _product(velocity, axis), _product(acceleration, axis), rotation

    def of_body(body: Inertia, _: str, rotation: Bound) -> tuple[Bound, Callable[[Bound], Bound]]:
        max_moment = float(np.linalg.eigvalsh(body.moments)[-1])
        inertia = max_moment * np.stack(
            [still[0] + 1, 2 * rotation[0], 2 * rotation[1] + 4 * rotation[0] ** 2]
        )
        return _rotating(float(np.linalg.norm(body.com)), rotation), lambda w: _product(inertia, w)

    at_base = still, still, still, np.stack([still[0] + GRAVITY, *still[1:]])
    loads = _newton_euler(problem, at_base, of_joint, of_body, _product)
    return np.stack([_product(*load)[2] for load in loads], axis=1)


def _rotating(length: float, rotation: Bound) -> Bound:
    """The `Bound` of a vector that is fixed to a link, from its length and the `Bound` of the link's angular
    velocity."""
    return length * np.stack([1 + 0 * rotation[0], rotation[0], rotation[1] + rotation[0] ** 2])


def _link_inertias(problem: Problem) -> dict[str, list[Inertia]]:
    """The inertias of each link, with the payload's."""
    payload = problem.payload
    inertias = {link: [inertia] for link, inertia in problem.robot.inertias.items()}
    assert payload is not None
    if payload.mass > MIN_MASS:
        link = payload.link or problem.robot.tip
        inertias.setdefault(link, []).append(Inertia(payload.mass, payload.com, np.diag(payload.moments)))
    return inertias


AVERAGING_WINDOWS = (1e-3, 4e-3, 16e-3)
"""Windows over which mean accelerations are tested [s]. Between rows closer than the first window, the
tolerance of positions may hide a large acceleration. If there are such rows, the longer windows are tested
too."""
AGREEMENT = 0.5
"""How far a row's acceleration may be outside the range between those of the cubics before and after it, as a
fraction of the joint's peak acceleration in the motion."""
REST_SHARE = 0.01
"""In AGREEMENT, the peak counts as at least this fraction of the joint's limit."""
JUMP = 1e-6
"""In a motion for which jerks are stated: largest jump of an acceleration, and largest difference of a row's
acceleration from those of its cubics, as a fraction of the joint's limit (without one, of its peak)."""
MIN_JERK = 1e-6
"""Jerks below this are rounding errors [rad/s³] or [m/s³]."""
# Samples at which a motion is tested for passing within a blend: largest distance between them, as a fraction
# of the blend, and largest number from one row to the next.
BLEND_SHARE = 0.25
MAX_BLEND_SAMPLES = 10_000
UNTIMED = "certificates prove nothing about moving obstacles for a path, which has no times"
MIN_TIME = 1e-12
"""Smallest time by which the tolerance of a mean velocity is divided [s]."""


def configurations(motion: Path | Trajectory, between: Values) -> Configurations:
    """The rows of a motion and further configurations between them, in order.

    between: times on the cubics between rows [s]; for a path, the index of a row plus the fraction of the way
    to the next row, on the straight line between them.
    """
    cubics = cubics_of(motion)
    rows = cubics.rows(between)
    q = np.concatenate([motion.positions, cubics.at(rows, between - cubics.times[rows])[0]])
    return q[np.argsort(np.concatenate([clock(motion), between]), kind="stable")]


def deviations(motion: Path | Trajectory, between: Values) -> JointRows:
    """Upper bounds on how far each joint leaves the straight line from each of the `configurations` to the
    next [rad] or [m]."""
    return cubics_of(motion).deviations(places_of(motion, between))


def not_checked(problem: Problem, motion: Path | Trajectory) -> list[str]:
    """Descriptions of what the checker does not check. The validator checks sharp reversals."""
    path = isinstance(motion, Path)
    parts = {
        "sharp reversals": True,
        "velocities, accelerations and times, which a path does not have": path,
        "start_velocity": path and problem.start_velocity is not None,
        "space that no view has observed": problem.views,
    }
    return [description for description, unchecked in parts.items() if unchecked]


def requirement_errors(problem: Problem, certificate: MotionProof) -> Iterator[str]:
    """A message for each requirement that the motion violates, or is not proved to meet."""
    robot = problem.robot
    motion = certificate.motion
    tolerances = certificate.tolerances
    if problem.moving and isinstance(motion, Path):
        yield f"problem: {UNTIMED}"
    extreme_positions = np.concatenate([motion.positions, cubics_of(motion).turning_points])
    beyond = np.maximum(robot.lower - extreme_positions, extreme_positions - robot.upper)
    beyond[:, robot.continuous] = 0.0
    for j in np.flatnonzero(~(beyond <= tolerances.limit_slack).all(axis=0)):
        yield f"motion: {robot.joint_names[j]} leaves its limits by {beyond[:, j].max():.3g}"
    off = np.abs(motion.positions[0] - problem.start).max(initial=0.0)
    if not off <= tolerances.start_tolerance:
        yield f"motion: it begins {off:.3g} off the start"
    if not at_goal(robot, problem.goal, motion.positions[-1:], tolerances).all():
        yield "motion: it does not end at the goal"
    yield from _waypoint_errors(problem, certificate)
    if isinstance(motion, Trajectory):
        start_velocity = np.zeros(robot.dof) if problem.start_velocity is None else problem.start_velocity
        yield from _rate_errors(robot, motion, certificate, start_velocity)
        yield from frame_speed_errors(problem, motion, tolerances.rate_slack)
    yield from _jerk_errors(robot, motion, certificate)
    yield from _constraint_errors(problem, certificate)
    yield from _torque_errors(problem, certificate)


def place_errors(problem: Problem, certificate: MotionProof) -> list[str]:
    """Errors that would make all other tests meaningless: joints of another robot; times that do not begin at
    0 or do not increase; places in the proof that are outside the motion or appear twice; and places in
    `between` that are times of rows."""
    motion = certificate.motion
    robot = problem.robot
    if tuple(motion.joint_names) != robot.joint_names:
        return [f"motion: its joints are {joined(motion.joint_names)}, not {joined(robot.joint_names)}"]
    times = clock(motion)
    if times[0] != 0:
        return [f"motion: its times begin at {times[0]:g} s, not at 0"]
    if not (np.diff(times) > 0).all():
        return ["motion: its times do not increase"]
    # `looks` is the name of torque_samples in files
    for name, places in (("between", certificate.between), ("looks", certificate.torque_samples)):
        if not ((places > 0) & (places < times[-1])).all() or len(np.unique(places)) < len(places):
            return [f"motion: the places of `{name}` must be inside the motion and different from each other"]
    if isinstance(motion, Trajectory) and np.isin(certificate.between, times).any():
        return ["motion: the times of `between` do not lie between its rows"]
    return []


def cubic_jerks(robot: Robot, motion: Path | Trajectory) -> JointValues | None:
    """The largest jerk of each joint along the cubics; None for a path, for a trajectory of one row, and for
    a trajectory whose accelerations jump or differ from those of its cubics."""
    if isinstance(motion, Path) or len(motion.times) < 2:
        return None
    cubics = cubics_of(motion)
    limits = np.where(robot.acceleration > 0, robot.acceleration, cubics.peak_accelerations.max(axis=0))
    written = motion.accelerations
    off = np.maximum(np.abs(written[:-1] - cubics.start), np.abs(written[1:] - cubics.end))
    if not (cubics.jumps() <= JUMP * limits).all() or not (off <= JUMP * limits).all():
        return None
    return cubics.jerks.max(axis=0)


def _jerk_errors(robot: Robot, motion: Path | Trajectory, certificate: MotionProof) -> Iterator[str]:
    """If the proof states jerks: a message for each joint with a larger jerk, or a single message if they are
    those of other joints or the motion has no `cubic_jerks`."""
    stated = dict(certificate.jerks)
    if not stated:
        return
    if [name for name, _ in certificate.jerks] != [*motion.joint_names]:
        yield "jerks: their joints are not those of the motion"
        return
    max_jerks = cubic_jerks(robot, motion)
    if max_jerks is None:
        yield "jerks: the motion is a path, or its accelerations jump or are not those of the cubics"
        return
    for name, jerk in zip(stated, max_jerks, strict=True):
        if not jerk <= stated[name] * (1 + BOUND_TOLERANCE) + MIN_JERK:
            yield f"jerks: that of {name} is {jerk:.6g}, not {stated[name]:.6g}"


def _waypoint_errors(problem: Problem, certificate: MotionProof) -> Iterator[str]:
    """The first waypoint that the motion misses. It must reach the waypoints in order, and either stop at
    each or pass within its blend."""
    robot = problem.robot
    motion = certificate.motion
    tolerances = certificate.tolerances
    line = configurations(motion, certificate.between)
    numbers = np.arange(len(line), dtype=float)
    stops = numbers[np.isin(places_of(motion, certificate.between), clock(motion))]  # the rows
    if isinstance(motion, Trajectory):
        stops = stops[(np.abs(motion.velocities) <= tolerances.rest).all(axis=1)]
    after = 0.0
    for k, (goal, blend) in enumerate(zip(problem.waypoints, problem.blend, strict=True)):
        places = stops
        if blend:
            # samples on the straight lines that were certified, closer together than the blend is wide
            lengths = step_lengths(line)
            counts = np.clip(np.ceil(lengths / (BLEND_SHARE * blend)), 1, MAX_BLEND_SAMPLES).astype(int)
            within = [i + np.arange(count) / count for i, count in enumerate(counts)]
            places = np.concatenate([*within, numbers[-1:]])
        places = places[places >= after]
        q = interpolated(places, numbers, line)
        reached = np.flatnonzero(at_goal(robot, goal, q, tolerances, blend))
        if not len(reached):
            requirement = f"pass within {blend:g} of" if blend else "stop at"
            yield f"motion: it does not {requirement} waypoints[{k}] after those before it"
            return
        after = float(places[reached[0]])


def _torque_errors(problem: Problem, certificate: MotionProof) -> Iterator[str]:
    """A message for each torque bound that differs from the bound in the proof, and for each torque that is
    not proved to be within its limit with the payload; a single message if the proof has torques of other
    joints, or torques without a payload in the problem."""
    motion = certificate.motion
    stated = certificate.torques
    if problem.payload is None:
        if stated:
            yield "torques: the problem has no payload"
        return
    max_torques = torque_bounds(problem, motion, certificate.torque_samples).max(axis=0)
    allowed = problem.robot.effort * (1 + certificate.tolerances.rate_slack)
    yield from _stated_errors("torques", stated, problem.robot.joint_names, max_torques, allowed)


def _constraint_errors(problem: Problem, certificate: MotionProof) -> Iterator[str]:
    """A message for each bound that differs from the bound in the proof, and for each path constraint that is
    not proved to be kept."""
    names, bounds, limits = (), np.zeros((1, 0)), ()
    if problem.constraints:
        q = configurations(certificate.motion, certificate.between)
        names, bounds, limits = constraint_bounds(problem, q, certificate.tolerances.chord)
    yield from _stated_errors("constraints", certificate.constraints, names, bounds.max(axis=0), limits)


def _stated_errors(
    what: str,
    stated: Sequence[tuple[str, float]],
    names: Sequence[str],
    bounds: Iterable[float],
    limits: Iterable[float],
) -> Iterator[str]:
    """A message for each bound that differs from the bound in the proof, and for each bound that exceeds its
    limit; a single message if the proof has bounds with other names."""
    if [name for name, _ in stated] != [*names]:
        yield f"{what}: they are not those of the problem"
        return
    for (name, written), bound, limit in zip(stated, bounds, limits, strict=True):
        if not abs(bound - written) <= BOUND_TOLERANCE:
            yield f"{what}: the bound of {name} is {bound:.6f}, not {written:.6f}"
        if not bound <= limit:
            yield f"{what}: {name} is not shown to keep its limit: {bound:.6f} of {limit:.6f}"


def _rate_errors(
    robot: Robot, motion: Trajectory, certificate: MotionProof, start_velocity: JointValues
) -> Iterator[str]:
    """A message for each joint that exceeds a velocity or acceleration limit, by any of several measures, or
    whose accelerations are not near those of its cubics; if cubics leave the certified straight lines; and if
    the motion does not begin at the required velocity or end at rest."""
    tolerances = certificate.tolerances
    times = motion.times
    step = np.diff(times)[:, None]
    cubics = cubics_of(motion)
    off = deviations(motion, certificate.between)
    if not off.max(initial=0.0) <= tolerances.chord * (1 + 1e-6) + 1e-12:
        yield "motion: its cubics leave the straight lines that were certified"
    q = motion.positions
    v = motion.velocities
    a = motion.accelerations
    rate_factor = 1 + tolerances.rate_slack
    position_slack = 2 * tolerances.limit_slack
    speed = robot.velocity
    acceleration = robot.acceleration
    change = np.diff(v, axis=0) / step
    # an error e of the mean velocity changes the cubic's velocities by up to 1.5 e, and its accelerations by
    # up to 6 e / step
    acceleration_slack = 6 * position_slack / step**2
    yield from _agreement_errors(robot, motion, cubics, start_velocity, acceleration_slack)
    for quantity, values, limit, slack in (
        ("velocity", v, speed, 0.0),
        (
            "mean velocity between rows",
            np.diff(q, axis=0) / step,
            speed,
            position_slack / np.maximum(step, MIN_TIME),
        ),
        ("acceleration", a, acceleration, 0.0),
        ("mean acceleration between rows", change, acceleration, 0.0),
        ("velocity along its cubics", cubics.speeds, speed, 1.5 * position_slack / step),
        ("acceleration along its cubics", cubics.peak_accelerations, acceleration, acceleration_slack),
    ):
        yield from _exceeded(robot, quantity, np.abs(values), limit, rate_factor * limit + slack)
    beyond = _excess_displacement(motion, rate_factor, position_slack, speed)
    message = "it moves {:.3g} further than {:.4g} allows"
    yield from _exceeded(
        robot, "mean velocity from one row to another", beyond, speed, position_slack, message
    )
    fine_steps = step.min(initial=np.inf) < AVERAGING_WINDOWS[0]
    for window in AVERAGING_WINDOWS if fine_steps else AVERAGING_WINDOWS[:1]:
        # before the first row, the arm moves at its start velocity; after the last row, it rests
        at = np.concatenate([[times[0] - window], times, [times[-1] + window]])
        rows = np.concatenate([q[:1] - window * start_velocity, q, q[-1:]])
        first = np.searchsorted(at, times - window, side="right") - 1
        last = np.searchsorted(at, times + window, side="left")
        before = (times - at[first])[:, None]
        after = (at[last] - times)[:, None]
        spacing = (before + after) / 2
        # second divided difference: by the mean value theorem, the joint reaches this acceleration
        mean_acceleration = np.abs((rows[last] - q) / after - (q - rows[first]) / before) / spacing
        # number of neighbors outside the motion, whose velocity may be off by rate_slack
        outside = ((first == 0) * 1.0 + (last == len(at) - 1))[:, None]
        slack = position_slack / before + position_slack / after + outside * tolerances.rate_slack * speed
        quantity = "mean acceleration computed from positions"
        lines = [
            *_exceeded(
                robot, quantity, mean_acceleration, acceleration, rate_factor * acceleration + slack / spacing
            )
        ]
        yield from lines
        if lines:
            break
    reference_speed = np.where(speed > 0, speed, np.abs(v).max(axis=0, initial=0.0))
    end_errors = np.abs(np.stack([v[0] - start_velocity, v[-1]]))
    if (end_errors > tolerances.rate_slack * reference_speed + tolerances.rest).any():
        message = "at the problem's start_velocity, or end" if start_velocity.any() else "and end"
        yield f"motion: it does not begin {message} at rest"


def _exceeded(
    robot: Robot,
    what: str,
    values: JointRows,
    limit: JointValues,
    allowed: ndarray | float,
    how: str = "{:.4g} > {:.4g}",
) -> Iterator[str]:
    """A message for each joint that has a limit and exceeds the allowed value in any row."""
    over = ~(values <= allowed) & (limit > 0)
    for j in np.flatnonzero(over.any(axis=0)):
        excess = how.format(values[over[:, j], j].max(), limit[j])
        yield f"motion: {robot.joint_names[j]} exceeds its limit of {what}: {excess}"


def _excess_displacement(
    motion: Trajectory, rate_factor: float, position_slack: float, speed: JointValues
) -> JointRows:
    """For each joint, by how much its displacement between two rows exceeds what its velocity limit allows in
    the time between them: the largest value of all pairs of rows [1, dof].

    For each step between the two rows, a tolerance of `position_slack` is allowed; proportionally less for a
    step shorter than the first averaging window. The caller allows this tolerance once more, for the two rows
    themselves.
    """
    step = np.diff(motion.times)[:, None]
    q = motion.positions
    allowed = np.zeros_like(q)
    max_travel = rate_factor * speed * step + position_slack * np.minimum(step / AVERAGING_WINDOWS[0], 1.0)
    np.cumsum(max_travel, axis=0, out=allowed[1:])
    # largest excess over all earlier rows, by a running minimum
    advance = np.stack([q, -q]) - allowed
    return (advance - np.minimum.accumulate(advance, axis=1)).max(axis=(0, 1))[None]


def _agreement_errors(
    robot: Robot, motion: Trajectory, cubics: Cubics, start_velocity: JointValues, acceleration_slack: ndarray
) -> Iterator[str]:
    """A message for each joint with an acceleration at a row that is further than AGREEMENT from the range
    between those of the cubics before and after the row."""
    before = np.concatenate([cubics.start[:1], cubics.end])
    after = np.concatenate([cubics.start, cubics.end[-1:]])
    a = motion.accelerations
    off = np.maximum(np.minimum(before, after) - a, a - np.maximum(before, after)).clip(0.0)
    if start_velocity.any():
        off[:1] = 0.0  # the acceleration of the motion before this one is not known
    peak = np.abs(np.concatenate([cubics.peak_accelerations, a])).max(axis=0)
    peak = np.maximum(peak, REST_SHARE * robot.acceleration)
    slack = np.maximum(
        np.concatenate([acceleration_slack[:1], acceleration_slack]),
        np.concatenate([acceleration_slack, acceleration_slack[-1:]]),
    )
    for j in np.flatnonzero(~(off <= AGREEMENT * peak + slack).all(axis=0)):
        excess = f"{off[:, j].max():.4g} off those of its cubics"
        yield f"motion: accelerations of {robot.joint_names[j]} are {excess}"


def at_goal(robot: Robot, goal: Goal, q: Configurations, tolerances: Tolerances, blend: float = 0.0) -> Mask:
    """Whether each configuration reaches a goal, or is within `blend` of it.

    blend: for a joint goal, a distance in joint space [rad, L2]; for a pose, the distance of positions [m],
    from the box of its position tolerances if it has any.
    """
    if isinstance(goal, AnyGoal):
        return np.any([at_goal(robot, part, q, tolerances, blend) for part in goal.goals], axis=0)
    if isinstance(goal, PosesGoal):
        return np.all([at_goal(robot, part, q, tolerances, blend) for part in goal.poses], axis=0)
    if isinstance(goal, JointGoal):
        off = goal.positions - q[:, None]
        off = np.where(robot.continuous, np.arctan2(np.sin(off), np.cos(off)), off)
        within_distance = (np.abs(off) <= tolerances.goal_tolerance).all(axis=2)
        return (within_distance | (np.linalg.norm(off, axis=2) <= blend)).any(axis=1)
    linkage = Linkage(robot)
    T_goal = goal.T_base_frame
    T = linkage.place(q).T[:, linkage.links.index(goal.frame)]
    xyz = (T[:, :3, 3] - T_goal[:3, 3]) @ T_goal[:3, :3]
    turn = T_goal[:3, :3].T @ T[:, :3, :3]
    if goal.xyz_tolerance is None:
        within_distance = np.linalg.norm(xyz, axis=1) <= max(tolerances.goal_distance, blend)
    else:
        beyond = np.maximum(np.abs(xyz) - goal.xyz_tolerance - tolerances.goal_slack, 0.0)
        within_distance = np.linalg.norm(beyond, axis=1) <= blend
    if goal.rpy_tolerance is None:
        angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1.0, 1.0))
        return within_distance & (angle <= tolerances.goal_angle + tolerances.goal_slack)
    roll = np.arctan2(turn[:, 2, 1], turn[:, 2, 2])
    pitch = np.arcsin(np.clip(-turn[:, 2, 0], -1.0, 1.0))
    yaw = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
    rpy_solutions = np.stack([(roll, pitch, yaw), (roll + np.pi, np.pi - pitch, yaw + np.pi)])
    rpy_solutions = (rpy_solutions + np.pi) % (2 * np.pi) - np.pi
    allowed = (goal.rpy_tolerance + tolerances.goal_slack)[:, None]
    return within_distance & (np.abs(rpy_solutions) <= allowed).all(axis=1).any(axis=0)
