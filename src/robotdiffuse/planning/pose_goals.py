"""Goal configurations for poses of one link, or of several links at once, by inverse kinematics."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.constraints import PositionBox
from robotdiffuse.problems.goals import PoseGoal, PosesGoal
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, beside, inverse_kinematics
from robotdiffuse.validation.tolerances import DEFAULT, goal_error

GOAL_COUNT = 10
"""Number of configurations to find for a pose (the paper's k)."""
SAMPLED_POSES, CONFIGURATIONS_PER_POSE = 20, 2
"""Poses sampled within the tolerances of a goal, and configurations to find for each."""
SAMPLED_POSE_SETTINGS = InverseKinematicsSettings(max_rounds=2, patience=1)
"""For sampled poses: many of them may be out of reach."""
CONSTRAINED_SETTINGS = InverseKinematicsSettings(max_rounds=8, patience=2)
"""Under path constraints, which no configuration may keep; and for each of several poses."""
TOLERANCE_FRACTION, MIN_HALF_BOX = 0.9, 2e-4
"""Part of the tolerances that projected goals keep; smallest half edge of the box that they are kept in
[m]."""
COMBINATIONS, MAX_ROUNDS, PATIENCE = 64, 8, 2
"""For several poses: combinations of the configurations of each that are tried in a round, most rounds, and
most rounds in a row without a new configuration."""
MIN_DIFFERENCE = 0.1
"""Configurations for several poses differ by more than this in at least one joint [rad] or [m]."""

Accept = Callable[[Float[ndarray, "n dof"]], ndarray]


def pose_configurations(
    problem: Problem,
    goal: PoseGoal | PosesGoal,
    constraints: PathConstraints | None,
    rng: np.random.Generator,
    accept: Accept | None = None,
) -> Float[ndarray, "k dof"]:
    """At most GOAL_COUNT configurations that bring links to their poses, or to poses within their tolerances.

    Other arms of the robot stay at the problem's start.

    constraints: path constraints that the configurations keep; None: none.
    accept: which configurations are acceptable, as for `inverse_kinematics`.
    """
    if isinstance(goal, PosesGoal):
        return _several_poses(problem, goal, rng, accept)
    if constraints is not None:
        return _with_constraints(problem, goal, constraints, rng, accept)
    robot, rest = problem.robot, problem.start
    if not goal.tolerant:
        return inverse_kinematics(
            robot, goal.frame, goal.T_base_frame, GOAL_COUNT, rng=rng, accept=accept, rest=rest
        )
    found = np.zeros((0, robot.dof))
    for i in range(SAMPLED_POSES):
        T_base_frame = goal.draw(rng) if i else goal.T_base_frame
        few = inverse_kinematics(
            robot,
            goal.frame,
            T_base_frame,
            CONFIGURATIONS_PER_POSE,
            rng=rng,
            accept=accept,
            settings=SAMPLED_POSE_SETTINGS,
            rest=rest,
        )
        found = np.concatenate([found, few])
        if len(found) >= GOAL_COUNT:
            break
    return found[:GOAL_COUNT]


def _with_constraints(
    problem: Problem,
    goal: PoseGoal,
    constraints: PathConstraints,
    rng: np.random.Generator,
    accept: Accept | None,
) -> Float[ndarray, "k dof"]:
    """`pose_configurations` under path constraints: for a pose with tolerances, configurations are projected
    onto the constraints, and kept if they are still within the tolerances."""
    found = np.zeros((0, problem.robot.dof))

    def keeps(q: ndarray) -> ndarray:
        kept = constraints.satisfied(q)
        return kept if accept is None else kept & accept(q)

    def reached(T_base_frame: ndarray, count: int, accept: Accept | None) -> ndarray:
        robot, settings = problem.robot, CONSTRAINED_SETTINGS
        return inverse_kinematics(
            robot,
            goal.frame,
            T_base_frame,
            count,
            rng=rng,
            accept=accept,
            settings=settings,
            rest=problem.start,
        )

    if not goal.tolerant:
        return reached(goal.T_base_frame, GOAL_COUNT, keeps)
    xyz = np.full(3, 0.5 * DEFAULT.goal_distance) if goal.xyz_tolerance is None else goal.xyz_tolerance
    half = np.maximum(xyz, MIN_HALF_BOX)
    box = PositionBox(goal.frame, -half, half, goal.T_base_frame)
    within = PathConstraints(replace(problem, constraints=(*problem.constraints, box)))
    for i in range(SAMPLED_POSES):
        few = reached(goal.draw(rng) if i else goal.T_base_frame, CONFIGURATIONS_PER_POSE, None)
        few = np.concatenate([few[constraints.satisfied(few)], within.projected(few, TOLERANCE_FRACTION)])
        at_goal = [goal_error(problem.robot, goal, q) is None for q in few]
        few = few[np.array(at_goal, bool)]
        found = np.concatenate([found, few if accept is None or not len(few) else few[accept(few)]])
        if len(found) >= GOAL_COUNT:
            break
    return found[:GOAL_COUNT]


def _several_poses(
    problem: Problem, goal: PosesGoal, rng: np.random.Generator, accept: Accept | None
) -> Float[ndarray, "k dof"]:
    """`pose_configurations` for several poses together, with the problem's constraints."""
    found = np.zeros((0, problem.robot.dof))
    for i in range(SAMPLED_POSES if goal.tolerant else 1):
        poses = [replace(pose, T_base_frame=pose.draw(rng)) if i else pose for pose in goal.poses]
        count = min(CONFIGURATIONS_PER_POSE, GOAL_COUNT - len(found)) if goal.tolerant else GOAL_COUNT
        found = np.concatenate([found, _at_poses(problem, poses, count, rng, accept)])
        if len(found) >= GOAL_COUNT:
            break
    return found


def _at_poses(
    problem: Problem,
    poses: Sequence[PoseGoal],
    count: int,
    rng: np.random.Generator,
    accept: Accept | None,
) -> Float[ndarray, "k dof"]:
    """Configurations with all links exactly at their poses, by combining configurations for each pose alone.

    That is enough for arms that share no joint. Where they share joints, a combination takes these from one
    of the poses, and Newton steps for all poses and constraints together start from there.
    """
    robot, start = problem.robot, problem.start
    each = [
        inverse_kinematics(
            robot,
            pose.frame,
            pose.T_base_frame,
            GOAL_COUNT,
            rng=rng,
            settings=CONSTRAINED_SETTINGS,
            rest=start,
        )
        for pose in poses
    ]
    found = np.zeros((0, robot.dof))
    if not all(len(alone) for alone in each):
        return found
    together = PathConstraints(problem, poses)
    own = [~beside(robot, pose.frame) for pose in poses]
    idle = 0
    for _ in range(MAX_ROUNDS):
        seeds, before = np.tile(start, (COMBINATIONS, 1)), len(found)
        for k in rng.permutation(len(poses)):
            seeds[:, own[k]] = each[k][rng.integers(len(each[k]), size=COMBINATIONS)][:, own[k]]
        solved = together.projected(seeds, TOLERANCE_FRACTION)
        if accept is not None and len(solved):
            solved = solved[accept(solved)]
        for q in solved:
            if len(found) < count and (np.abs(found - q).max(axis=1, initial=0.0) > MIN_DIFFERENCE).all():
                found = np.concatenate([found, q[None]])
        idle = 0 if len(found) > before else idle + 1
        if len(found) >= count or (len(found) and idle >= PATIENCE):
            break
    return found
