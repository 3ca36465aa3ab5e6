"""Straight lines of the tool, followed from the start by inverse kinematics from pose to pose.

Following takes milliseconds and gives smooth motions. If the line cannot be followed to its end, the search
under path constraints (`search/constrained.py`) takes over. If that fails too, the result says how far the
line can be followed and what stops the arm there.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import path_length
from robotdiffuse.core.transforms import rotation_about
from robotdiffuse.core.types import Configuration, Configurations, PlanResult, Pose, Poses, Status
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.problems.compiled_constraints import line_end, pose_difference
from robotdiffuse.problems.constraints import CartesianLine
from robotdiffuse.problems.problem import JointGoal, PoseGoal, Problem
from robotdiffuse.robots.ik_kernel import IKChain, IKParameters, follow, solve_seeds
from robotdiffuse.robots.inverse_kinematics import (
    MAX_ITERATIONS,
    PARAMETERS,
    ROTATION_WEIGHT,
    InverseKinematicsSettings,
    ik_chain,
    inverse_kinematics,
)
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.curve_timing import time_curve
from robotdiffuse.trajectories.speed_limits import duration_of, scaled_limits, symmetric_bounds
from robotdiffuse.trajectories.timing_kernel import fastest_speeds

STAGE = "line"
# Largest distance [m] and angle [rad] between neighboring poses of the line; smallest and largest number of
# steps from pose to pose along the line (a long line has MAX_STEPS longer steps).
STEP = 0.008
TURN_STEP = 0.04
MIN_STEPS = 6
MAX_STEPS = 400
MAX_JOINT_STEP = 0.25
"""If a joint would move by more than this from one pose to the next, the line cannot be followed [rad] or
[m]."""
LIMIT_MARGIN = 1e-3
"""Distance that joints keep from their limits at the poses, since the curve between poses may come closer
[rad] or [m]."""
NEAR_LIMIT = 1e-2
"""A joint closer than this to its limit is named as the reason why the line cannot be followed [rad] or
[m]."""
OTHER_ENDS = 4
"""Number of configurations of the end pose that are tried as goals if following without a goal configuration
stops early."""
END_STEPS = np.array([0.1, 0.3, 0.7])
"""Null-space steps from one configuration of the end pose to seeds of others [rad, L2]."""
LONGER = 1.08
"""A path that ends in another configuration of the end pose may be this many times as long in joint space as
the path that was followed first."""
HERE = 1e-5
"""The link is at the end of the line if each entry of its pose (translation [m] and rotation matrix) differs
from the end pose by less than this."""
SAME = 1e-5
"""A followed line reaches a goal configuration if each joint ends closer than this to it [rad] or [m]."""
TOLERANCES = 1e-9, 1e-9
"""Tolerances of inverse kinematics at the poses [m], [rad]. They are small, because the second derivative of
the curve divides errors by the square of the step."""
CLEARANCE_SHARE = 0.5
"""A note names the clearance of a motion that keeps less than this fraction of the clearance of the call."""
ROUND = InverseKinematicsSettings(max_rounds=1)
"""Settings of the inverse kinematics that finds OTHER_ENDS."""


def follow_line(context: PlanningContext) -> PlanResult | None:
    """The fastest of several motions that follow the line from the start and pass the validator.

    If there is no such motion, a failed result: its `fraction` and `reason` say how far the line can be
    followed and what stops the arm. None for an `AnyGoal` or `PosesGoal`. Also None if the link is at the end
    of the line already, but the validator refuses that it stays there, e.g. since the goal is another
    configuration.
    """
    problem = context.problem
    robot = problem.robot
    if not isinstance(problem.goal, PoseGoal | JointGoal):
        return None
    line = next(entry for entry in problem.constraints if isinstance(entry, CartesianLine))
    T_end = line_end(problem, line)
    T_start = robot.fk(problem.start, line.frame)
    if np.abs(T_end - T_start)[:, 3 if line.angle is None else slice(None)].max() < HERE:
        rest = np.stack([problem.start, problem.start])
        return context.finish(rest, STAGE, "the start is the end of the line")
    targets = _poses(T_start, T_end)
    fraction = 0.0
    why = ""
    candidates = list[tuple[float, Configurations]]()
    chain = ik_chain(robot, line.frame, LIMIT_MARGIN)
    limits = scaled_limits(robot, context.timing)

    def cost(rows: Configurations) -> float:
        """Approximate minimum duration [s] of a motion through configurations within the limits of velocity
        and acceleration."""
        first = np.gradient(rows, axis=0)
        second = np.diff(rows, 2, axis=0)
        second = np.concatenate([second[:1], second, second[-1:]])
        bounds = symmetric_bounds(limits[1], len(rows))
        grid = np.arange(float(len(rows)))
        return duration_of(grid, fastest_speeds(first, second, grid, limits[0], *bounds))

    def tried(end: Configuration | None) -> bool:
        """Whether the line can be followed to its last pose, while joints are steered to the configuration
        `end` if it is given. The motion becomes a candidate if it ends in this configuration."""
        nonlocal fraction, why
        rows = _followed(problem, line, targets, *chain, end)
        fraction_followed = (len(rows) - 1) / len(targets)
        if fraction_followed < 1.0:
            if fraction_followed >= fraction:
                fraction = fraction_followed
                why = _obstruction(robot, rows[-1])
        elif end is None or np.abs(rows[-1] - end).max() < SAME:
            candidates.append((cost(rows), rows))
        else:
            fraction = 1.0
            why = "there the arm has another configuration than the goal"
        return fraction_followed == 1.0

    if isinstance(problem.goal, JointGoal):
        for end in robot.nearest_turns(problem.goal.positions, problem.start):
            tried(end)
    elif not tried(None):
        ends = inverse_kinematics(
            robot,
            line.frame,
            T_end,
            OTHER_ENDS,
            rng=context.rng,
            settings=replace(ROUND, position_only=line.angle is None),
            near=problem.start,
            rest=problem.start,
        )
        for end in ends:
            tried(end)
    elif line.speed is None:  # `tried(None)` has followed the line to its end, and added a candidate
        best_cost, followed = candidates[0]
        candidates += faster_ends(problem, line, targets, *chain, best_cost, followed, cost)
    for _, rows in sorted(candidates, key=lambda entry: entry[0]):
        trajectory = time_curve(robot, rows, context.timing, context.extra_limits)
        context.improved(float(path_length(rows)))
        result = context.finish(rows, STAGE, "solved along the straight line", trajectory=trajectory)
        if result is not None:
            return _with_clearance_note(context, result)
        if context.ended:
            break
        fraction_followed, message = context.refused_at
        if fraction_followed >= fraction:
            fraction = fraction_followed
            why = message
    why = f"from the start the line can be followed for {100 * fraction:.0f} %: {why}"
    return replace(context.fail(Status.NO_PATH, why), fraction=fraction)


def _with_clearance_note(context: PlanningContext, result: PlanResult) -> PlanResult:
    """The result, with a note if the motion keeps much less than the clearance of the call, although start
    and end keep more."""
    ends = result.path.positions[[0, -1]]
    checker = CollisionChecker(context.problem.robot, context.problem.scene)
    at_ends = float(checker.link_clearances(ends).min(initial=np.inf))
    clearance = result.scene_clearance
    if clearance >= CLEARANCE_SHARE * min(context.clearance, at_ends):
        return result
    note = (
        f"the motion along the line does not keep a clearance of {100 * context.clearance:.2g} cm; "
        f"it keeps {100 * clearance:.2g} cm"
    )
    return replace(result, notes=(*result.notes, note))


def _poses(T_start: Pose, T_end: Pose) -> Poses:
    """Poses T_base_link along the line, evenly spaced, without the start and with the end."""
    displacement, turn = pose_difference(T_start, T_end)
    angle = float(np.linalg.norm(turn))
    count = max(np.linalg.norm(displacement) / STEP, angle / TURN_STEP, MIN_STEPS)
    fractions = np.linspace(0, 1, min(int(np.ceil(count)), MAX_STEPS) + 1)[1:, None]
    axis = turn / angle if angle > 0 else np.eye(3)[2]
    poses = np.tile(T_end, (len(fractions), 1, 1))
    poses[:-1, :3, 3] = T_start[:3, 3] + fractions[:-1] * displacement
    poses[:-1, :3, :3] = rotation_about(axis, angle * fractions[:-1, None]) @ T_start[:3, :3]
    return poses


def faster_ends(
    problem: Problem,
    line: CartesianLine,
    targets: Poses,
    arm: Int[ndarray, "j"],
    joints: IKChain,
    best_cost: float,
    rows: Configurations,
    cost: Callable[[Configurations], float],
) -> list[tuple[float, Configurations]]:
    """Costs and motions along the line that end in the last configuration of `rows`, or in other
    configurations of the end pose.

    arm, joints: from `ik_chain`. Each returned motion has a lower cost than `best_cost` and than the motions
    before it, and is at most LONGER times as long as `rows`.
    """
    end = rows[-1]
    max_length = LONGER * path_length(rows)
    constrained = 3 if line.angle is None else 6
    parameters = PARAMETERS._replace(position_only=line.angle is None)
    jacobian = problem.robot.jacobian(end, line.frame)[:constrained, arm]
    faster = list[tuple[float, Configurations]]()
    redundant = np.linalg.svd(jacobian)[2][constrained:]
    # with the zero offset, the line is followed to the same end again, but joints are steered to this end
    # from the start on
    offsets = [
        0 * redundant[:1],
        *(np.outer(steps, direction) for direction in redundant for steps in (END_STEPS, -END_STEPS)),
    ]
    for offset in offsets:
        for seed in np.clip(end[arm] + offset, joints.lower, joints.upper):
            solutions = solve_seeds(seed[None], seed[None][:0], 1, joints, targets[-1], parameters)[0]
            moved = end.copy()
            moved[arm] = solutions[0] if len(solutions) else seed
            steered = _followed(problem, line, targets, arm, joints, moved)
            arrived = len(steered) > len(targets) and np.abs(steered[-1] - moved).max() < SAME
            estimated = cost(steered) if arrived and path_length(steered) <= max_length else np.inf
            if estimated >= best_cost:
                break
            best_cost = estimated
            faster.append((best_cost, steered))
    return faster


def _followed(
    problem: Problem,
    line: CartesianLine,
    targets: Poses,
    arm: Int[ndarray, "j"],
    joints: IKChain,
    end: Configuration | None,
) -> Configurations:
    """Configurations at the start and at the poses in `targets`, up to the last pose that joints can follow.

    end: the goal configuration to which the joints `arm` are steered; None: no steering. Joints that do not
    move the link move linearly to their values in `end`, or stay.
    """
    start = problem.start
    steer = end is not None
    goal = start if end is None else end
    joints = joints._replace(
        lower=np.minimum(joints.lower, np.minimum(start, goal)[arm]),
        upper=np.maximum(joints.upper, np.maximum(start, goal)[arm]),
    )
    parameters = IKParameters(line.angle is None, ROTATION_WEIGHT, *TOLERANCES, MAX_ITERATIONS, 0.0)
    rows = follow(start[arm], goal[arm], steer, MAX_JOINT_STEP, targets, joints, parameters)
    q = start + np.linspace(0, 1, len(targets) + 1)[: len(rows), None] * (goal - start)
    q[:, arm] = rows
    return q


def _obstruction(robot: Robot, q: Configuration) -> str:
    """Why a line cannot be followed beyond this configuration."""
    limit_distance = np.where(robot.continuous, np.inf, -robot.limit_excess(q))
    j = int(limit_distance.argmin())
    if limit_distance[j] < NEAR_LIMIT:
        joint = robot.planned_joints[j]
        return f"{joint.name} is at its limit there, {q[j]:.3f} {joint.unit}"
    return "the arm is at the edge of its reach there, or a joint would have to jump"
